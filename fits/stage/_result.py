"""What the fit of a stage gives back."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fits.io._errors import DataError
from fits.io._record import Record
from fits.io.columns import COLUMNS, columns_beside
from fits.loop._misfit import Misfit
from fits.loop._result import FitStatus, Prediction, RunReport, pool, refuse_outside
from fits.stage._run import (
    StageRun,
    gain_ahead,
    place_of_hysteresis,
    prepare_stage_run,
    simulate_stage,
)
from fits.stage._uncertainty import StageUncertainty
from fits.stats._metrics import Errors
from microid import AbstractEffect, Preisach, Stage, innermost


@dataclass(frozen=True)
class ParameterEstimate:
    """One parameter of a stage.

    Attributes
    ----------
    name
        Part and field, such as `mechanics.natural_frequency_Hz`.
    unit
        Its unit.
    value
        The estimate.
    sd
        Its standard deviation, the noise as coloured as the residual is.
    lower, upper
        Ends of its 95 % interval, within its bounds.
    """

    name: str
    unit: str
    value: float
    sd: float
    lower: float
    upper: float


@dataclass(frozen=True)
class StageFit:
    """A fitted stage, and how far to trust it.

    Attributes
    ----------
    model
        The stage, with the offset of the first run.
    uncertainty
        Of its predictions.
    status
        How the fit ended.
    remarks
        What the user should know, one sentence each.
    parameters
        Those outside of the hysteresis' grid, in the order of the solver's coordinates.
    correlation
        Between them, shape `(p, p)`.
    unseen
        Combinations of parameters that the data leave open, one sentence each.
    noise_um
        Standard deviation of each fitted run's residual.
    correlation_samples
        Number of residual samples of each run that are worth one independent one.
    substeps
        Steps into which each interval of each run was divided.
    runs
        One report per fitted run, then one per held-out record.
    misfit
        How far the residual of the run that is described worst is from noise.
    """

    model: Stage
    uncertainty: StageUncertainty
    status: FitStatus
    remarks: tuple[str, ...]
    parameters: tuple[ParameterEstimate, ...]
    correlation: np.ndarray
    unseen: tuple[str, ...]
    noise_um: tuple[float, ...]
    correlation_samples: tuple[float, ...]
    substeps: tuple[int, ...]
    runs: tuple[RunReport, ...]
    misfit: Misfit | None = None

    def __getitem__(self, name: str) -> ParameterEstimate:
        for parameter in self.parameters:
            if parameter.name == name:
                return parameter
        raise KeyError(
            f"no parameter {name!r} was fitted: choose one of {', '.join(p.name for p in self.parameters)}"
        )

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
        """Predict the displacement of a voltage program; see `predict_stage`."""
        return predict_stage(self.model, self.uncertainty, record, initial)


def range_of(stage: Stage) -> tuple[float, float]:
    """Commands that a stage was fitted on, in V; unlimited without a Preisach operator."""
    place = place_of_hysteresis(stage)
    law = None if place is None else innermost(stage.parts[place])
    if isinstance(law, Preisach):
        gain = gain_ahead(stage)
        assert gain is not None
        return float(law.density.lower_V) / gain, float(law.density.upper_V) / gain
    return -np.inf, np.inf


def prepare_again(stage: Stage, records: Sequence[Record], initial: str, holdout: float) -> list[StageRun]:
    """Make the records ready on which a stage was fitted; without a Preisach operator they give the range."""
    range_V = range_of(stage)
    if not np.isfinite(range_V[0]):
        range_V = (min(float(r.voltage_V.min()) for r in records), max(float(r.voltage_V.max()) for r in records))
    settings = initial, holdout, stage.substeps, gain_ahead(stage), stage.hold
    return [prepare_stage_run(record, range_V, *settings) for record in records]


def predict_stage(
    stage: Stage, uncertainty: StageUncertainty | None, record: Record, initial: str = "negative"
) -> Prediction:
    """Predict the displacement of a voltage program through a whole stage, with its uncertainty.

    Parameters
    ----------
    stage, uncertainty
        From a fit or a model file; without an uncertainty its standard deviations are NaN.
    record
        The program; its displacement, if any, is not looked at.
    initial
        Memory before the first sample: `negative`, `positive` or `demagnetised`.

    Raises
    ------
    DataError
        If the voltage leaves the range that the stage was fitted on, or the stage has an effect of another column
        that the program lacks.
    """
    lower, upper = range_of(stage)
    refuse_outside(record, lower, upper)
    program = Record(record.time_s, record.voltage_V, np.zeros(len(record)), record.extra, source=record.source)
    missing = sorted(
        {name for part in stage.parts if isinstance(part, AbstractEffect) for name in part.needs}
        - {name for name, column in COLUMNS.items() if column.optional}
        - set(columns_beside(program))
    )
    if missing:
        raise DataError(
            f"{record.source}: the model depends on {', '.join(missing)}: add a column of that name that varies"
        )
    run = prepare_stage_run(program, (lower, upper), initial, 1.0, stage.substeps, gain_ahead(stage), stage.hold)
    # The program is refined already.
    stage = stage.with_substeps(1)
    sd = np.full(len(record), np.nan)
    if uncertainty is not None:
        sd = uncertainty.sd_um(stage, run)
    return Prediction(simulate_stage(stage, run), sd)
