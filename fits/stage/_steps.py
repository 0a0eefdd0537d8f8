"""The two halves of fitting a stage: a place to begin, read off the runs, and the joint fit from there."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import jax.numpy as jnp
import numpy as np

from fits.io._errors import DataError
from fits.loop._choose_grid import choose_grid
from fits.loop._misfit import misfits, without_impulses
from fits.loop._result import FitError, FitStatus
from fits.loop._run import Run, simulate_run
from fits.stage._chain import offsets_out
from fits.stage._checks import UNSEEN, check_gains, refuse_slopes, refuse_unidentifiable, shows_poles, speed_Hz
from fits.stage._lag_place import lag_placed
from fits.stage._plan import Plan
from fits.stage._run import (
    free_grid,
    hysteresis_of,
    named_parts,
    place_of_hysteresis,
    simulate_stage,
    yields_inside,
)
from fits.stage._solve import Problem, Solved, solve_chain, try_chain
from fits.stage._start import MeasuredResponse, measure_response, start_lagging, start_stages
from fits.stage._uncertainty import Precision
from microid import Driver, Mechanics, Preisach, Stage, innermost
from microid.effects import EFFECTS

# Where a part is left out more than noise is left, and no run counts as quieter than another.
_EVEN = 1.0
# How many times what a start leaves, on average, is too much beside one that has a lag of the reading, too.
_BAD = 3.0
# How many times what is left beside a mode, on average, must be left beside a lag of the reading instead.
_CLEAR = 1.1
# Part of the sampling interval below which a driver's time constant hardly shows behind steps.
_SETTLED = 0.2
# Steps per sample that a fit takes at most.
_FINEST = 16


def starts_as_it_is(stage: Stage) -> bool:
    """Whether all of a stage is fitted from its present values, as a law that no regression solves for moves."""
    place = place_of_hysteresis(stage)
    to_move = place is not None and stage.names[place] not in stage.frozen
    if yields_inside(stage):
        if to_move and free_grid(stage) is not None:
            raise DataError(
                f"the weights of {stage.names[place or 0]} are solved for only ahead of linear parts, and a part "
                "behind them has a hysteresis inside: freeze these weights, or take another law there"
            )
        return True
    return to_move and free_grid(stage) is None and not isinstance(innermost(hysteresis_of(stage)), Preisach)


def present_problem(plan: Plan, stage: Stage) -> tuple[Plan, Problem]:
    """Begin at the present values of a stage, or at poles read off the runs where those fit better.

    Samples that depend on where a hysteresis inside the mechanics was before are left out.
    """
    stage = stage.with_substeps(1)
    try:
        problem = Problem.of(stage, None, np.zeros(0), None, 1.0)
    except ValueError as error:
        raise DataError(f"{error}: thaw some of the stage") from error
    runs = plan.runs()
    if yields_inside(stage):
        plan = replace(plan, settled=plan.settled_for(stage, runs))
        return plan, _best_start(plan, [problem], plan.runs()).onward
    drives = hysteresis_alone(stage, runs)
    poles = start_stages(stage, [measure_response(*each) for each in zip(runs, drives, strict=True)])
    problems = [problem, *(replace(problem, z=np.asarray(problem.chain.coordinates.of(one))) for one in poles)]
    return plan, _best_start(plan, problems, runs).onward


def _best_start(plan: Plan, problems: Sequence[Problem], runs: list[Run]) -> Solved:
    """Fit roughly from several starts, and take the best; the last `FitError` where each fails."""
    found: list[Solved] = []
    failure = FitError(FitStatus.NONFINITE)
    for number, problem in enumerate(problems):
        plan.progress(f"start {number + 1} of {len(problems)}")
        try:
            found.append(solve_chain(problem, runs, plan.loss, plan.progress, rough=True))
        except FitError as error:
            failure = error
    if not found:
        raise failure
    return min(found, key=lambda one: one.cost)


def start_problem(plan: Plan, stage: Stage, levels: int | None, finest: int) -> Problem:
    """Read a hysteresis off the slow runs and poles off the others."""
    # Readings that jump out and back are left out, as a start must not be read off them.
    plan, asked = replace(plan, records=tuple(map(without_impulses, plan.records))), stage
    speed = [speed_Hz(record) for record in plan.records]
    slow = [k for k, one in enumerate(speed) if one <= 4.0 * min(speed)]  # all others are fast
    fitted = free_grid(stage)
    grid, columns, hyper, stroke = None, np.zeros(0), None, 1.0
    runs = plan.runs()
    if fitted is not None:
        name = fitted[0]
        refuse_slopes([plan.records[k] for k in slow])
        loose = [stage.named(row.path) for row in offsets_out(stage, True).table if row.path.endswith(".gain")]
        if loose:
            raise DataError(
                f"{', '.join(loose)} and the weights of {name} are both free, but only their product is seen, "
                f"not each: freeze {loose[0]}, or the {name}"
            )
        plan.progress(f"hysteresis from {', '.join(plan.records[k].source for k in slow)}")
        stroke, tried, _ = choose_grid([runs[k] for k in slow], levels, plan.progress, finest)
        grid, hyper = tried.data.grid, tried.solution.hyper
        columns = np.asarray(tried.solution.columns) * stroke
        stage = stage.swap(name, grid.model(columns, np.zeros(())))
    drives = hysteresis_alone(stage, runs)
    fast = [k for k in range(len(plan.records)) if k not in slow] or slow
    responses = [measure_response(runs[k], drives[k]) for k in fast]
    starts = [Problem.of(one, grid, columns, None, stroke) for one in start_stages(stage, responses)]
    solved = replace(_best_start(plan, starts, runs), hyper=hyper)
    problem = solved.onward
    lag_beside = cache(lambda: _beside_lag(plan, problem, runs, responses))
    try:
        dropped = refuse_unidentifiable(solved, drives, fast=fast != slow, may_drop=not plan.accept_best)
    except DataError:
        # A hysteresis read off runs that are all as fast has taken in the lag of the driver.
        other = _from_command(plan, problem, runs, starts, lag_beside) if fast == slow else None
        if other is not None and _identifiable(other, drives, False):
            return lag_placed(plan, other).onward
        if not plan.accept_best:
            if fast == slow and (lagging := _lagging(plan, problem, runs, drives)):
                return lagging
            raise
        lagged = None if fast == slow else _without_mechanics(plan, solved, asked, levels, finest, runs)
        if lagged is not None and not any(one.far for one in misfits(runs, lagged.residuals_um)):
            return lagged.onward
        beside = lag_beside()
        if lagged is not None and (beside is None or not _identifiable(beside, drives, fast != slow)):
            return lagged.onward
        if beside is None:
            raise
        refuse_unidentifiable(beside, drives, fast=fast != slow)
        return _without_lag(problem, beside)
    if fitted is not None:
        freed = lag_placed(plan, solved)
        if any(one.far for one in misfits(runs, freed.residuals_um)):
            freed = _freed(plan, freed, drives, responses, fast != slow)
        if plan.accept_best or _identifiable(freed, drives, fast != slow):
            solved, dropped = freed, None
            problem = solved.onward
    if dropped is not None:
        # Begin without a mechanics that the runs do not show.
        simpler = start_problem(plan, asked.without(dropped), levels, finest)
        remarks = (_no_resonance(plan, dropped), *simpler.remarks)
        return replace(simpler, least_noise_share=_EVEN, remarks=remarks, full=solved)
    return replace(problem, remarks=(*problem.remarks, *check_gains(solved.stage, runs)))


def _from_command(
    plan: Plan, problem: Problem, runs: list[Run], starts: Sequence[Problem], lag_beside: Callable[[], Solved | None]
) -> Solved | None:
    """Go on from poles that the command itself shows, the hysteresis free.

    None without a mode that has a peak, or where hardly more is left beside a lag of the reading instead.
    """
    if problem.chain.grid is None or problem.hyper is None:
        return None
    shown = start_stages(problem.stage, [measure_response(run, run.voltage_V) for run in runs])
    places, found = [*(start.z for start in starts), *(problem.chain.coordinates.of(one) for one in shown)], []
    for z in places:
        one = try_chain(replace(problem, z=np.asarray(z)), runs, plan.loss, plan.progress, rough=True)
        if one and all(float(mode.damping_ratio) < 0.5**0.5 for _, mode in named_parts(one.stage, Mechanics)):
            found.append(one)
    if not found or (beside := lag_beside()) is None:
        return None
    best = min(found, key=lambda one: one.cost)
    least = math.log(_CLEAR) * sum(int(run.fitted.sum()) for run in runs)
    return best if best.cost < beside.cost - least else None


def _freed(
    plan: Plan, solved: Solved, drives: Sequence[np.ndarray], responses: Sequence[MeasuredResponse], fast: bool
) -> Solved:
    """Go on from a rough fit that is far from noise with the hysteresis free, which was read off beforehand.

    What a fit in a bad minimum leaves looks like many things; beside a lag of the reading it may find the poles.
    """
    runs = solved.runs
    beside = _beside_lag(plan, solved.onward, runs, responses)
    if beside is None or not _identifiable(beside, drives, fast):
        return solved
    there = try_chain(_without_lag(solved.onward, beside), runs, plan.loss, plan.progress, rough=True)
    least = math.log(_BAD) * sum(int(run.fitted.sum()) for run in runs)
    if there is not None and (there.cost < solved.cost or solved.cost - beside.cost > least):
        return there
    return solved


def _without_lag(problem: Problem, beside: Solved) -> Problem:
    """Go on from a fit that had a lag of the reading at the end, with the driver as late as both together."""
    lag: Any = beside.stage.parts[-1]
    stage = beside.stage.without(beside.stage.names[-1])
    for name, driver in named_parts(stage, Driver)[:1]:
        stage = stage.swap(name, replace(driver, time_constant_s=driver.time_constant_s + getattr(lag, lag.lag)))
    return replace(problem, z=np.asarray(problem.chain.coordinates.of(stage)), columns_um=beside.columns_um)


def _identifiable(solved: Solved, drives: Sequence[np.ndarray], fast: bool) -> bool:
    try:
        refuse_unidentifiable(solved, drives, fast)
    except DataError:
        return False
    return True


def _without_mechanics(
    plan: Plan, solved: Solved, asked: Stage, levels: int | None, finest: int, runs: list[Run]
) -> Solved | None:
    """Fit driver and hysteresis to runs that show no resonance; None where they show no lag either."""
    modes, drivers = named_parts(asked, Mechanics), named_parts(asked, Driver)
    if len(modes) != 1 or not drivers:
        return None
    dropped = modes[0][0]
    plan.progress("a lag without a resonance")
    try:
        problem = start_problem(plan, asked.without(dropped), levels, finest)
    except (DataError, FitError, np.linalg.LinAlgError):
        return None
    remarks = (_no_resonance(plan, dropped), *problem.remarks)
    problem = replace(problem, least_noise_share=_EVEN, remarks=remarks, full=solved)
    return try_chain(problem, runs, plan.loss, plan.progress, accept_best=True)


def _beside_lag(
    plan: Plan, problem: Problem, runs: list[Run], responses: Sequence[MeasuredResponse]
) -> Solved | None:
    """Fit roughly with a lag of the reading at the end, which the stage lacks; None where that cannot be fitted.

    Without that lag a fit may run away from poles that the runs show beside it.
    """
    lagging: Any = next(form for form in EFFECTS if form.lag)
    starts = []
    for stage, lag_s in start_lagging(problem.stage, responses):
        lagged = stage.append(lagging.name, lagging(**{lagging.lag: jnp.asarray(lag_s)}))
        held = lagged.freeze(*(f"{lagging.name}.{field}" for field in lagging.history))
        starts.append(Problem.of(held, problem.chain.grid, problem.columns_um, problem.hyper, problem.stroke_um))
    try:
        return _best_start(plan, starts, runs)
    except FitError:
        # There are no starts where the responses say nothing.
        return None


def _no_resonance(plan: Plan, name: str) -> str:
    return (
        f"{', '.join(record.source for record in plan.records)}: these runs show a lag, but no resonance, so {name} "
        "was left out of the stage, which predicts what is as fast as these runs, and nothing faster; add a run with "
        "steps, a chirp or a multisine that goes beyond the resonance to have it"
    )


def _lagging(plan: Plan, problem: Problem, runs: list[Run], drives: Sequence[np.ndarray]) -> Problem | None:
    """Fit hysteresis and driver together, without mechanics; None where the driver's lag does not show."""
    stage, grid = problem.stage, problem.chain.grid
    drivers, mechanics = (named_parts(stage, kind) for kind in (Driver, Mechanics))
    if len(drivers) != 1 or len(mechanics) > 1 or grid is None or problem.hyper is None:
        return None
    (name, old), remarks = drivers[0], tuple(_no_resonance(plan, dropped) for dropped, _ in mechanics)
    for dropped, _ in mechanics:
        stage = stage.without(dropped)
    simple = stage.swap(name, Driver(jnp.asarray(3.0 * plan.interval_s), old.gain))
    simpler = Problem.of(simple, grid, problem.columns_um, problem.hyper, problem.stroke_um)
    simpler = replace(simpler, least_noise_share=_EVEN, remarks=remarks)
    plan.progress("a lag without a resonance")
    solved = try_chain(simpler, runs, plan.loss, plan.progress)
    if solved is None or not shows_poles(solved, drives) or float(np.max(Precision(solved).sd)) > UNSEEN:
        return None
    return solved.onward


def hysteresis_alone(stage: Stage, runs: Sequence[Run]) -> list[np.ndarray]:
    """What the hysteresis of a stage would give by itself for each run, in um, shape `(n,)`."""
    law = hysteresis_of(stage)
    if isinstance(law, Preisach):
        return [simulate_run(law, run) for run in runs]
    commands = [run.record.voltage_V for run in runs]
    return commands if law is None else [np.asarray(law(jnp.asarray(voltage))) for voltage in commands]


def _visible(plan: Plan, problem: Problem) -> Problem:
    """The same from drivers that samples show: no derivative leads back to one that settles between held commands."""
    stage = problem.chain.stage(jnp.asarray(problem.z), jnp.asarray(problem.columns_um))
    least_s = _SETTLED * plan.interval_s
    quick = [(name, one) for name, one in named_parts(stage, Driver) if float(one.time_constant_s) < least_s]
    if "zero" not in plan.holds or not quick:
        return problem
    for name, driver in quick:
        stage = stage.swap(name, replace(driver, time_constant_s=jnp.asarray(least_s)))
    return replace(problem, z=np.asarray(problem.chain.coordinates.of(stage)))


def refine_problem(plan: Plan, problem: Problem, strides: Sequence[int] = ()) -> tuple[Solved, Precision]:
    """Fit, and fit again with the intervals divided, from so many steps on, if their length moves a parameter."""
    refined, problem = bool(strides), _visible(plan, problem)
    strides = list(strides) or [1] * len(plan.records)
    while True:
        runs = plan.runs(strides)
        solved = solve_chain(problem, runs, plan.loss, plan.progress, accept_best=plan.accept_best)
        precision = Precision(solved)
        inside = yields_inside(solved.stage)
        if not inside and (plan.gain is None or refined):
            return solved, precision
        moved, halved = np.zeros((len(runs), len(solved.z))), plan.runs([2 * stride for stride in strides])
        shown = np.zeros(len(runs))
        for k, (own, run, finer) in enumerate(zip(precision.influence, runs, halved, strict=True)):
            off = simulate_stage(solved.stage, run) - simulate_stage(solved.stage, finer)
            off -= off[run.fitted].mean()
            moved[k], shown[k] = own @ off, np.std(off[run.fitted]) / solved.weighing.noise_um[k]
        # Halving the step takes three quarters of its error off, which falls with its square; the steps of all runs
        # together may move a parameter by 0.15 standard deviations, and those of each its response by 0.02.
        whole, each = (np.max(np.abs(m) / precision.sd, -1) / (0.75 * 0.15) for m in (moved.sum(axis=0), moved))
        shown /= 0.75 * 0.02
        if max(whole, *shown) <= 1:
            return solved, precision
        if max(strides) == _FINEST:
            said = f"{_FINEST} steps per sample are few: more would move a parameter by {0.15 * whole:.2g} sd"
            remarks = (*problem.remarks, said) if whole > 1 else problem.remarks
            return replace(solved, problem=replace(problem, remarks=remarks)), precision
        # In twice as many, or as the error asks for, where a run has its part in it.
        share = np.maximum(np.maximum(each * len(runs), shown), 1.0)
        more = [2 ** math.ceil(math.log2(own) / 2) for own in share]
        strides, refined = [min(_FINEST, stride * factor) for stride, factor in zip(strides, more, strict=True)], True
        plan.progress(f"{' and '.join(map(str, strides))} steps per sample")
        problem = solved.onward
