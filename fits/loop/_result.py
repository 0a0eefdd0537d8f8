"""What a fit gives back, of a hysteresis alone or of a whole stage."""

import enum
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

import numpy as np
from jaxtyping import Array, Float

from fits.io._given import AnyRuns, program_given
from fits.io._limits import Ranges, measured_ranges
from fits.io._record import Record
from fits.io._summary import AbstractSummary
from fits.loop._misfit import Misfit
from fits.loop._prediction import Initial, Prediction
from fits.loop._report import fit_report, preisach_of
from fits.loop._report_words import describe
from fits.loop._run import Run, initial_of
from fits.loop._uncertainty import AbstractUncertainty
from fits.stats._metrics import Errors, errors, loop_width_pct
from microid import Everett, Preisach, Stage, Staircase

_M = TypeVar("_M", Preisach, Stage)


class FitStatus(enum.Enum):
    """How a fit ended; the value says what to do."""

    CONVERGED = "the optimality conditions hold"
    MAX_STEPS = "the solver ran out of steps: fit a simpler model (fewer levels, parameters or modes)"
    NONFINITE = "the solver met a number that is not finite: look for absurd values in the data"
    UNSTABLE = "the closed loop is unstable: start from lower gains, as those of relay_start"
    LIMITS = "no gains were found that keep all limits: relax them, start elsewhere, or try a slower reference"
    NOT_STATIONARY = "the solver stopped where the cost still falls: try another model, or other values to start from"


class FitError(RuntimeError):
    """A fit, or a tuning, failed; it has no answer to give. The `status` says why, and what to do."""

    def __init__(self, status: FitStatus, detail: str = "", what: str = "fit"):
        super().__init__(f"the {what} failed: {status.value}{f' ({detail})' if detail else ''}")
        self.status = status


@dataclass(frozen=True)
class LevelTrial:
    """One resolution that was tried: a number of levels `N`.

    The root mean square error is that on blocks of the fitted samples, each predicted from the others; on at most 24
    levels where the resolution was given and there was nothing to compare.
    """

    levels: int
    error_um: float


@dataclass(frozen=True)
class ParameterEstimate:
    """One parameter of a stage, by part and field, such as `mechanics.natural_frequency_Hz`.

    The `value`, its standard deviation `sd`, and the ends `lower` and `upper` of the 95 % interval are in its unit.
    The interval is within the bounds, and both count the noise as coloured as the residual.
    """

    name: str
    unit: str
    value: float
    sd: float
    lower: float
    upper: float


@dataclass(frozen=True)
class RunReport:
    """How a model does on one run.

    `offset_um` is the sensor offset of the run. Errors are on the samples that were fitted (`in_sample`), and on
    those that were only predicted (`held_out`); None where there are none. `unknown` samples depend on an unknown
    past, and are neither fitted nor counted in the errors. `start` is the memory before the first sample; a
    hysteresis alone estimates it where it is unknown. Widths of the widest loop (Eq. 34) are None where the record
    holds none. What was `reached` are the ranges of voltage, slew and displacement in the record. `noise_um` is the
    standard deviation of the residual (of all runs, for a hysteresis alone), `correlation_samples` the number of its
    samples that are worth one independent one, and `substeps` the steps into which each interval was divided; None of
    a run that was only predicted. Where `has_past`, what an unknown past adds was estimated beside the rest.
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
    noise_um: float | None = None
    correlation_samples: float | None = None
    substeps: int | None = None
    has_past: bool = False

    @classmethod
    def of(
        cls, run: Run, predicted_um: np.ndarray, offset_um: float, start: Staircase, **figures: Any
    ) -> "RunReport":
        """Compare a prediction with a run; further figures are fields of the report."""
        measured, voltage = run.displacement_um, run.record.voltage_V[run.known]
        range_um = float(np.ptp(measured[run.known]))

        def compare(samples: np.ndarray) -> Errors | None:
            if not samples.any() or range_um == 0:
                return None
            return errors(measured[samples], predicted_um[samples], range_um)

        return cls(
            source=run.record.source,
            offset_um=offset_um,
            in_sample=compare(run.fitted),
            held_out=compare(run.held_out),
            unknown=int(np.sum(~(run.known | run.record.lost))),
            start=start,
            loop_measured_pct=loop_width_pct(voltage, measured[run.known]),
            loop_model_pct=loop_width_pct(voltage, predicted_um[run.known]),
            reached=measured_ranges(run.record),
            has_past=run.has_past,
            **figures,
        )


@dataclass(frozen=True, repr=False)
class FitResult(AbstractSummary, Generic[_M]):
    """A fitted hysteresis or stage, and how far to trust it.

    The `model` is the Preisach operator, or the stage, with the offset of the first run; `uncertainty` says how sure
    its predictions are, `status` how the fit ended, and `remarks`, one sentence each, what the user should know.
    There is one report per fitted run, then one per held-out record. `misfit` is how far the residual of the run that
    is described worst is from noise. `smoothness` is the weight on the squared curvature of the density that the data
    chose, in 1/strokes^2, None without a grid; `trials` are the resolutions that the fit of a hysteresis tried, in
    order. `parameters` are those of a stage outside of the hysteresis' grid, in the order of the solver's
    coordinates, with the correlation between them, shape `(p, p)`; `unseen` are combinations of them that the data
    leave open, one sentence each. `records` are those that were fitted.
    """

    model: _M
    uncertainty: AbstractUncertainty
    status: FitStatus
    remarks: tuple[str, ...]
    runs: tuple[RunReport, ...]
    misfit: Misfit | None = None
    smoothness: float | None = None
    trials: tuple[LevelTrial, ...] = ()
    parameters: tuple[ParameterEstimate, ...] = ()
    correlation: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    unseen: tuple[str, ...] = ()
    records: tuple[Record, ...] = ()

    def __getitem__(self, name: str) -> ParameterEstimate:
        for parameter in self.parameters:
            if parameter.name == name:
                return parameter
        names = ", ".join(parameter.name for parameter in self.parameters)
        known = f"choose one of {names}" if names else "a hysteresis has weights, in `weights_um`"
        raise KeyError(f"no parameter {name!r} was fitted: {known}")

    @property
    def fitted_runs(self) -> tuple[RunReport, ...]:
        """Reports of the runs that were fitted."""
        return tuple(run for run in self.runs if run.noise_um is not None)

    @property
    def noise_um(self) -> float:
        """Standard deviation of the residual at the fitted samples of all runs."""
        return float(self._pooled([(run.noise_um or 0.0) ** 2 for run in self.fitted_runs])) ** 0.5

    @property
    def correlation_samples(self) -> float:
        """Number of residual samples that are worth one independent one, in the mean over the fitted samples."""
        return self._pooled([run.correlation_samples or 1.0 for run in self.fitted_runs])

    def _pooled(self, values: list[float]) -> float:
        counts = [run.in_sample.samples if run.in_sample else 0 for run in self.fitted_runs]
        return float(np.average(values, weights=counts))

    @property
    def hysteresis(self) -> Preisach:
        """The Preisach operator, be it the model or a part of it; a `ValueError` where there is none."""
        found = preisach_of(self.model)
        if found is None:
            raise ValueError("the stage holds no Preisach operator")
        return found

    @property
    def weights_um(self) -> Float[Array, "N N"]:
        """The weights of Eq. 9."""
        return self.hysteresis.weights_um

    @property
    def everett(self) -> Everett:
        """The Everett surface, the paper's Preisach function (Eq. 10)."""
        return self.hysteresis.everett

    @property
    def in_sample(self) -> Errors:
        """Errors on all fitted samples together."""
        pooled = _pool(run.in_sample for run in self.runs)
        if pooled is None:
            raise ValueError("no run was fitted")
        return pooled

    @property
    def held_out(self) -> Errors | None:
        """Errors on all held-out samples together; None where nothing was held out."""
        return _pool(run.held_out for run in self.runs)

    def summary(self) -> str:
        """Say what was fitted, parameters with units, standard deviations and 95 % intervals, and how well."""
        return describe(fit_report(self))

    def predict(self, record: AnyRuns, initial: Initial | Staircase = "negative") -> Prediction:
        """Predict the displacement of a voltage program; see `fits.predict`."""
        return self.uncertainty.predict(self.model, program_given(record), initial_of(initial))


def _pool(parts: Iterable[Errors | None]) -> Errors | None:
    """Combine the errors of several runs; percentages refer to the largest range."""
    given = [part for part in parts if part is not None]
    if not given:
        return None
    samples = sum(part.samples for part in given)
    rms = np.sqrt(sum(part.samples * part.rms_um**2 for part in given) / samples)
    return Errors(samples, float(rms), max(part.max_um for part in given), max(part.range_um for part in given))
