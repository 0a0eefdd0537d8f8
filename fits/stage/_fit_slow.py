"""A hysteresis with a lag and relaxations behind it, fitted jointly to slow loops."""

from collections.abc import Sequence
from dataclasses import replace

import jax.numpy as jnp
import numpy as np

from fits.io._errors import DataError
from fits.io._record import Record
from fits.loop._choose_grid import choose_grid, weigh_robustly
from fits.loop._fit import check_fit
from fits.loop._misfit import misfits, remarks_on, worst
from fits.loop._result import FitResult
from fits.loop._run import Progress, Run, prepare_run
from fits.stage._fit import default_stage, summarise
from fits.stage._solve import Problem, solve_chain
from fits.stage._uncertainty import Precision
from microid import AbstractPart, Stage
from microid.effects.creep import KelvinVoigtCreep
from microid.effects.sensor_lowpass import SensorLowpass

# Relaxations begin so many intervals long, and end at such a part of the longest run.
_SHORTEST, _LONGEST = 20.0, 1 / 4
# Gain of a relaxation, and a lag in intervals, to start from.
_GAIN, _LAG = 0.01, 2.0
MOST_RELAXATIONS = 6


def fit_slow(
    records: Sequence[Record],
    *,
    lag: bool = False,
    relaxations: int = 0,
    levels: int | None = None,
    holdout: float | Sequence[Record] = 0.2,
    initial: str = "unknown",
    loss: str = "squares",
    progress: Progress = lambda _: None,
) -> FitResult[Stage]:
    fraction, aside, range_V = check_fit(records, holdout, loss)
    if not 0 <= relaxations <= MOST_RELAXATIONS:
        raise DataError(f"{relaxations} relaxations were asked for: choose between 0 and {MOST_RELAXATIONS}")
    stage = slow_stage(records, lag, relaxations)

    def prepare(record: Record, holdout: float) -> Run:
        return prepare_run(record, range_V, initial, holdout, 1, 1.0, stage.hold)

    runs = [prepare(record, fraction) for record in records]
    stroke, tried, trials = choose_grid(
        weigh_robustly(runs, progress) if loss == "huber" else runs, levels, progress, finest=32
    )
    columns = np.asarray(tried.solution.columns) * stroke
    problem = Problem.of(stage, tried.data.grid, columns, tried.solution.hyper, stroke)
    solved = solve_chain(problem, runs, loss, progress, accept_best=True)
    progress("comparing with the measurement")
    found = summarise(Precision(solved), [prepare(record, 1.0) for record in aside])
    left = misfits(solved.runs, solved.residuals_um)
    odd = remarks_on(solved.runs, solved.residuals_um, robust=loss == "huber")
    notes = [warning for record in (*records, *aside) for warning in record.warnings]
    return replace(found, misfit=worst(left), trials=tuple(trials), remarks=(*odd, *notes, *found.remarks))


def slow_stage(records: Sequence[Record], lag: bool, relaxations: int) -> Stage:
    """A hysteresis, as many relaxations, and a lag of the first order."""
    interval = min(float(np.median(np.diff(record.time_s))) for record in records)
    longest = _LONGEST * max(record.duration_s for record in records)
    constants = np.geomspace(min(_SHORTEST * interval, longest), longest, relaxations)
    parts: dict[str, AbstractPart] = {"hysteresis": default_stage()["hysteresis"]}
    for k, constant in enumerate(constants):
        parts[f"relaxation_{k + 1}"] = KelvinVoigtCreep(jnp.asarray(_GAIN), jnp.asarray(constant))
    if lag:
        parts["lag"] = SensorLowpass(jnp.asarray(_LAG * interval))
    return Stage.of(**parts).freeze(*(f"{name}.time_constant_s" for name in parts if name.startswith("relaxation")))
