"""Where the lag of a stage lies: in its driver, in the damping of its mode, or behind the hysteresis."""

import math
from dataclasses import replace

import jax.numpy as jnp
import numpy as np

from fits.loop._misfit import Misfit, misfits
from fits.stage._encode import spec_of
from fits.stage._plan import Plan
from fits.stage._run import named_parts
from fits.stage._solve import Problem, Solved, try_chain
from fits.stage._start import with_lag_elsewhere
from microid import Driver, Lag, Stage

# How many times what a lag behind the hysteresis leaves, on average, one ahead of it must leave, and how many times
# what both leave the one behind it may.
_CLEAR, _ALIKE = 1.1, 1.05
# What is left, in noise of the sensor, from which on a lag may be in the wrong place.
_MORE = 1.5
# Part of a lag that a driver begins with beside it, and that is none.
_LITTLE, _NONE = 0.1, 0.02
# Steps between samples of what is tried.
_STEPS = 4
_SAID = (
    "the lag of the stage lies behind the hysteresis in these runs, as that of a linear plant does or of a sensor's "
    "filter, and none shows ahead of it: the stage has no driver"
)


def lag_placed(plan: Plan, solved: Solved) -> Solved:
    """Go on from a rough fit with the hysteresis free, and with the lag where that leaves least."""
    runs, settings = solved.runs, (plan.loss, plan.progress)
    solved = try_chain(solved.onward, runs, *settings, rough=True) or solved
    if all(one.times_noise < _MORE for one in _left(solved)):
        return solved
    places = [np.asarray(solved.problem.chain.coordinates.of(stage)) for stage in with_lag_elsewhere(solved.stage)]
    moved = (try_chain(replace(solved.onward, z=z), runs, *settings, rough=True) for z in places)
    best = min(filter(None, (solved, *moved)), key=lambda one: one.cost)
    return (_behind(plan, best) if plan.movable else None) or best


def placed_onward(plan: Plan, problem: Problem) -> Problem:
    """Begin from a fit with its lag where that leaves least."""
    solved = try_chain(problem, plan.runs(), plan.loss, plan.progress, rough=True)
    return problem if solved is None else lag_placed(plan, solved).onward


def _behind(plan: Plan, solved: Solved) -> Solved | None:
    """Go on from a rough fit with the lag of the driver behind the hysteresis.

    None unless the runs leave clearly less so, and hardly less beside a driver that lags, too: what lags behind then
    is something else.
    """
    stage, runs = solved.stage, solved.runs
    drivers = named_parts(stage, Driver)
    if len(drivers) != 1 or "zero" in plan.holds or all(one.times_noise < _MORE for one in _left(solved)):
        return None
    (name, driver), samples = drivers[0], sum(int(run.fitted.sum()) for run in runs)
    later = stage.names[stage.names.index(name) + 2 :]
    lag = Lag(driver.time_constant_s)
    both = stage.insert(stage.names.index(later[0]), "lag", lag) if later else stage.append("lag", lag)
    plan.progress("the lag behind the hysteresis")
    alone = _solve(plan, solved, both.without(name))
    if alone is None or alone.cost > solved.cost - math.log(_CLEAR) * samples:
        return None
    found: Lag = alone.stage["lag"]  # type: ignore[assignment]
    spec = spec_of(driver.__dataclass_fields__["time_constant_s"])
    least_s = 0.0 if spec is None else spec.lower
    # Beyond the least that it may be, which no derivative leads back from.
    little = replace(driver, time_constant_s=jnp.maximum(_LITTLE * found.time_constant_s, 2 * least_s))
    beside = _solve(plan, alone, both.swap(name, little).swap("lag", found))
    if beside is not None and beside.cost < alone.cost - math.log(_ALIKE) * samples:
        ahead: Driver = beside.stage[name]  # type: ignore[assignment]
        # Few steps between samples are not exact, and one that lags by next to nothing makes up for that.
        if float(ahead.time_constant_s) > _NONE * float(found.time_constant_s):
            return None
    return replace(alone, problem=replace(alone.problem, remarks=(*alone.problem.remarks, _SAID)))


def _left(solved: Solved) -> list[Misfit]:
    return misfits(solved.runs, solved.residuals_um)


def _solve(plan: Plan, solved: Solved, stage: Stage) -> Solved | None:
    problem = solved.problem
    there = Problem.of(stage, problem.chain.grid, solved.columns_um, solved.hyper, problem.stroke_um)
    # A step of the command within an interval is passed on as a line of as few pieces.
    runs = plan.runs([_STEPS] * len(plan.records))
    return try_chain(there, runs, plan.loss, plan.progress, rough=True)
