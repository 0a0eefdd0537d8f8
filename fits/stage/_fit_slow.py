"""A hysteresis with a lag and relaxations behind it, fitted jointly to slow loops."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np

from fits.io._errors import DataError
from fits.io._given import AnyRuns, holdout_given, records_given
from fits.io._record import Record
from fits.loop._choose_grid import choose_grid, weigh_robustly
from fits.loop._fit import check_fit
from fits.loop._lost import without_lost
from fits.loop._prior import Hyper
from fits.loop._result import FitResult
from fits.loop._run import Progress, Run, prepare_run
from fits.stage._encode import spec_of
from fits.stage._fit import completed, summarise
from fits.stage._run import named_parts
from fits.stage._solve import Problem, solve_chain
from fits.stage._solve_stage import default_stage
from fits.stage._uncertainty import Precision
from microid import AbstractPart, Stage
from microid.effects import EFFECTS, AbstractEffect

# Relaxations begin so many intervals long, and end at such a part of the longest run.
_SHORTEST, _LONGEST = 20.0, 1 / 4
# Gain of a relaxation, and a lag in intervals, to start from.
_GAIN, _LAG = 0.1, 2.0
MOST_RELAXATIONS = 6
# A relaxation is not seen whose gain ends near its bound.
_MOST = 0.49


def fit_slow(
    records: AnyRuns,
    *,
    lag: bool = False,
    relaxations: int = 0,
    levels: int | None = None,
    holdout: float | AnyRuns = 0.2,
    initial: str = "unknown",
    loss: str = "squares",
    progress: Progress = lambda _: None,
) -> FitResult[Stage]:
    """Fit a Preisach operator to slow loops as `fit` does, together with what lags and relaxes behind it.

    Errors are those of `fit`. The stage has no mechanics; what moves before a run leave to relax is estimated for
    each run by itself, and is no part of the model.

    Parameters
    ----------
    lag
        Whether readings follow the displacement with a lag of the first order, whose time constant is fitted.
    relaxations
        Number of Kelvin-Voigt elements behind the hysteresis, at most 6. Their time constants are spread evenly over
        the logarithm, from 20 samples, or 20 ms, to a quarter of the longest run, and their gains are fitted; those
        that the runs do not show are left out.
    records, levels, holdout, initial, loss, progress
        See `fit`; a number of levels of at most 32 is chosen.
    """
    records, holdout = without_lost(records_given(records), holdout_given(holdout))
    fraction, aside, range_V = check_fit(records, holdout, loss, levels)
    if not 0 <= relaxations <= MOST_RELAXATIONS:
        raise DataError(f"{relaxations} relaxations were asked for: choose between 0 and {MOST_RELAXATIONS}")
    stage = _stage(records, lag, relaxations)

    def prepare(record: Record, holdout: float) -> Run:
        return replace(prepare_run(record, range_V, initial, holdout, 1, 1.0, stage.hold), moving=True)

    runs = [prepare(record, fraction) for record in records]
    weighed = weigh_robustly(runs, progress) if loss == "huber" else runs
    stroke, tried, _ = choose_grid(weighed, levels, progress, finest=32)
    columns = np.asarray(tried.solution.columns) * stroke
    hyper: Hyper | None = tried.solution.hyper
    remarks = list[str]()
    while True:
        problem = Problem.of(stage, tried.data.grid, columns, hyper, stroke)
        solved = solve_chain(problem, runs, loss, progress, accept_best=True)
        effects = [(name, part) for name, part in named_parts(solved.stage, AbstractEffect) if part.relaxation]
        unseen = [(name, part) for name, part in effects if float(getattr(part, part.strength[0])) > _MOST]
        if not unseen:
            break
        columns, hyper, stage = solved.columns_um, solved.hyper, solved.stage
        for name, part in unseen:
            # What moves before the runs leave to it stays.
            stage = stage.swap(name, replace(part, **{part.strength[0]: jnp.asarray(0.0)})).freeze(name)
            constant_s = float(getattr(part, part.relaxation))
            remarks.append(f"a relaxation of {constant_s:.3g} s is not seen in these runs, and was left out")
    progress("comparing with the measurement")
    found = summarise(Precision(solved), [prepare(record, 1.0) for record in aside])
    model = found.model
    for name in set(stage.frozen) & set(stage.names):
        model = model.without(name)
    found = replace(found, model=model, remarks=(*remarks, *found.remarks))
    return completed(found, solved, (*records, *aside), loss)


def _stage(records: Sequence[Record], lag: bool, relaxations: int) -> Stage:
    """A hysteresis, as many relaxations, and a lag of the first order."""
    interval = min(float(np.median(np.diff(record.time_s))) for record in records)
    longest = _LONGEST * max(record.duration_s for record in records)
    relaxing: Any = next(form for form in EFFECTS if form.relaxation)
    lagging: Any = next(form for form in EFFECTS if form.lag)
    spec = spec_of(relaxing.__dataclass_fields__[relaxing.relaxation])
    # What is faster is a lag.
    least = 0.0 if spec is None else spec.lower
    if relaxations and longest < least:
        raise DataError(
            f"the longest run takes {longest / _LONGEST:.3g} s, and relaxations from {least:g} s on show in runs of "
            f"{least / _LONGEST:g} s or more: record it for longer, or fit a lag"
        )
    constants = np.geomspace(min(max(_SHORTEST * interval, least), longest), longest, relaxations)
    parts: dict[str, AbstractPart] = {"hysteresis": default_stage()["hysteresis"]}
    for k, constant in enumerate(constants):
        parts[f"relaxation_{k + 1}"] = relaxing(
            **{relaxing.strength[0]: jnp.asarray(_GAIN), relaxing.relaxation: jnp.asarray(constant)}
        )
    held = [f"{name}.{field}" for name in [*parts][1:] for field in (relaxing.relaxation, *relaxing.history)]
    if lag:
        parts["lag"] = lagging(**{lagging.lag: jnp.asarray(_LAG * interval)})
        held += [f"lag.{field}" for field in lagging.history]
    return Stage(tuple(parts.values()), tuple(parts), frozen=tuple(held))
