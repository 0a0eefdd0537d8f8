"""What a fit gives back."""

import enum
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Array, Float

from fits.io._errors import DataError
from fits.io._limits import Ranges
from fits.io._record import Record
from fits.loop._misfit import Misfit
from fits.loop._run import prepare_run, simulate_run
from fits.loop._uncertainty import Uncertainty, sd_run
from fits.stats._metrics import Errors
from microid import Everett, Preisach, Staircase


class FitStatus(enum.Enum):
    """How a fit ended; the value says what to do."""

    CONVERGED = "the optimality conditions hold"
    MAX_STEPS = "the solver ran out of steps: fit a simpler model (fewer levels, parameters or modes)"
    NONFINITE = "the solver met a number that is not finite: look for absurd values in the data"
    UNSTABLE = "the closed loop is unstable: start from lower gains, as those of relay_start"
    LIMITS = "no gains were found that keep all limits: relax them, start elsewhere, or try a slower reference"
    NOT_STATIONARY = "the solver stopped where the cost still falls: try another model, or other values to start from"


class FitError(RuntimeError):
    """A fit, or a tuning, failed; it has no answer to give.

    Attributes
    ----------
    status
        Why, and what to do.
    """

    def __init__(self, status: FitStatus, detail: str = "", what: str = "fit"):
        super().__init__(f"the {what} failed: {status.value}{f' ({detail})' if detail else ''}")
        self.status = status


@dataclass(frozen=True)
class LevelTrial:
    """One resolution that was tried.

    Attributes
    ----------
    levels
        Number of levels `N`.
    error_um
        Root mean square error on blocks of the fitted samples, each predicted from the others; on at most 24 levels
        where the resolution was given and there was nothing to compare.
    """

    levels: int
    error_um: float


@dataclass(frozen=True)
class RunReport:
    """How a model does on one run.

    Attributes
    ----------
    source
        Name of the file.
    offset_um
        Sensor offset of the run.
    in_sample, held_out
        Errors on the samples that were fitted, and on those that were only predicted; None where there are none.
    unknown
        Number of samples that depend on an unknown past; neither fitted nor counted in the errors.
    start
        Memory before the first sample; estimated where it is unknown.
    loop_measured_pct, loop_model_pct
        Width of the widest loop (Eq. 34); None where the record holds none.
    reached
        Ranges of voltage, slew and displacement in the record, see `fits.io._limits.measured_ranges`.
    """

    source: str
    offset_um: float
    in_sample: Errors | None
    held_out: Errors | None
    unknown: int
    start: Staircase
    loop_measured_pct: float | None
    loop_model_pct: float | None
    reached: Ranges = field(default_factory=dict)


@dataclass(frozen=True)
class Prediction:
    """Predicted displacement of a voltage program.

    Attributes
    ----------
    displacement_um
        Shape `(n,)`.
    displacement_sd_um
        Its standard deviation from noise and smoothing, sensor noise not included, shape `(n,)`.
    """

    displacement_um: np.ndarray
    displacement_sd_um: np.ndarray


@dataclass(frozen=True)
class FitResult:
    """A fitted model, and how far to trust it.

    Attributes
    ----------
    model
        The Preisach operator, with the offset of the first run.
    uncertainty
        Of its predictions.
    status
        How the fit ended.
    remarks
        What the user should know, one sentence each.
    noise_um
        Standard deviation of the residual at the fitted samples.
    correlation_samples
        Number of residual samples that are worth one independent one; 1 for white noise.
    smoothness
        Weight on the squared curvature of the density that the data chose, in 1/strokes^2.
    trials
        The resolutions tried, in order.
    runs
        One report per fitted run, then one per held-out record.
    misfit
        How far the residual of the run that is described worst is from noise.
    """

    model: Preisach
    uncertainty: Uncertainty
    status: FitStatus
    remarks: tuple[str, ...]
    noise_um: float
    correlation_samples: float
    smoothness: float
    trials: tuple[LevelTrial, ...]
    runs: tuple[RunReport, ...]
    misfit: Misfit | None = None

    @property
    def weights_um(self) -> Float[Array, "N N"]:
        """The weights of Eq. 9."""
        return self.model.weights_um

    @property
    def everett(self) -> Everett:
        """The Everett surface, the paper's Preisach function (Eq. 10)."""
        return self.model.everett

    @property
    def in_sample(self) -> Errors:
        """Errors on all fitted samples together."""
        pooled = pool([run.in_sample for run in self.runs])
        if pooled is None:
            raise ValueError("no run was fitted")
        return pooled

    @property
    def held_out(self) -> Errors | None:
        """Errors on all held-out samples together; None where nothing was held out."""
        return pool([run.held_out for run in self.runs])

    def predict(self, record: Record, initial: str = "negative") -> Prediction:
        """Predict the displacement of a voltage program; see `predict`."""
        return predict(self.model, self.uncertainty, record, initial)


def pool(parts: list[Errors | None]) -> Errors | None:
    """Combine the errors of several runs; percentages refer to the largest range."""
    given = [part for part in parts if part is not None]
    if not given:
        return None
    samples = sum(part.samples for part in given)
    rms = np.sqrt(sum(part.samples * part.rms_um**2 for part in given) / samples)
    return Errors(samples, float(rms), max(part.max_um for part in given), max(part.range_um for part in given))


def predict(model: Preisach, uncertainty: Uncertainty, record: Record, initial: str = "negative") -> Prediction:
    """Predict the displacement of a voltage program, with its uncertainty.

    Parameters
    ----------
    model, uncertainty
        From a fit or a model file.
    record
        The program; its displacement, if any, is not looked at.
    initial
        Memory before the first sample: `negative`, `positive` or `demagnetised`.

    Raises
    ------
    DataError
        If the voltage leaves the range that the model was fitted on.
    """
    lower, upper = float(model.density.lower_V), float(model.density.upper_V)
    refuse_outside(record, lower, upper)
    run = prepare_run(record, lower, upper, initial, holdout=1.0)
    return Prediction(simulate_run(model, run), sd_run(uncertainty, run))


def refuse_outside(record: Record, lower_V: float, upper_V: float) -> None:
    """Refuse, in a `DataError`, a program that leaves the range that a model was fitted on."""
    slack = 1e-9 * (upper_V - lower_V) if np.isfinite(upper_V - lower_V) else 0.0
    outside = np.flatnonzero((record.voltage_V < lower_V - slack) | (record.voltage_V > upper_V + slack))
    if len(outside):
        first = int(outside[0])
        raise DataError(
            f"{record.source}: sample {first + 1} (time {record.time_s[first]:g} s) asks for "
            f"{record.voltage_V[first]:g} V, but the model was fitted between {lower_V:g} and {upper_V:g} V: "
            "clip the program or fit runs that cover it"
        )
