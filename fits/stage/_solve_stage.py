"""From records to the solution of a whole stage: what is read off first, what is asked for, and what came before."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from operator import or_
from typing import Any

import jax.numpy as jnp
import numpy as np

import microid as m
from fits.io._errors import DataError
from fits.io._record import Record
from fits.loop._choose_grid import LADDER
from fits.loop._fit import check_fit
from fits.loop._known import MOST, SOME, pasts_to_estimate
from fits.loop._misfit import misfits
from fits.loop._result import FitError
from fits.loop._run import Progress
from fits.loop._stepped import refuse_many_steps
from fits.stage._began import TURNS, as_begun, differ, doubted, weights_beside_pasts
from fits.stage._lag_place import placed_onward
from fits.stage._plan import Plan
from fits.stage._run import free_grid, gain_ahead, place_of_hysteresis
from fits.stage._solve import Problem, Solved
from fits.stage._steps import present_problem, refine_problem, start_problem, starts_as_it_is
from fits.stage._uncertainty import Precision


def default_stage(hold: m.Hold = "first") -> m.Stage:
    """The stage of Section 3.1: driver, Preisach operator and mechanics, with all gain in the operator.

    A gain anywhere else would only be seen together with it. `hold` says how the command runs between samples:
    `first` for lines, `smooth` for curves, `zero` for steps that each begin at a sample and are not seen by it yet.
    """
    flat = m.Preisach(
        m.densities.GridDensity(jnp.full(10, 0.1), jnp.asarray(0.0), jnp.asarray(1.0)),
        m.Reversible(jnp.ones(4), jnp.asarray(0.0), jnp.asarray(1.0)),
        jnp.asarray(0.0),
    )
    mechanics = m.Mechanics(jnp.asarray(100.0), jnp.asarray(0.1))
    stage = m.Stage.of(hold=hold, driver=m.Driver(jnp.asarray(1e-3)), hysteresis=flat, mechanics=mechanics)
    return stage.freeze("driver.gain", "mechanics.gain")


@dataclass(frozen=True)
class Solution:
    """What the fit of a stage found, for what plan; or the best place, and the `failure` that it ended with."""

    solved: Solved
    precision: Precision
    plan: Plan
    failure: FitError | None = None


def solve_with_pasts(
    records: Sequence[Record],
    stage: m.Stage | None,
    levels: int | None,
    holdout: float | Sequence[Record],
    initial: str | Sequence[str],
    loss: str,
    progress: Progress,
) -> Solution:
    """Fit a stage to what depends on no unknown past, where that is most, and go on with the rest; see `fit_stage`.

    What came before a run is estimated as something smooth. Where that is not what it was, it is looked for, and what
    is still left there counts for less.
    """
    settings = stage, levels, holdout, initial, loss, progress
    fraction, _, range_V = check_fit(records, holdout, loss, levels)
    unknown = set([initial] if isinstance(initial, str) else initial) == {"unknown"}
    free = unknown and (stage is None or free_grid(stage) is not None)
    pasts = pasts_to_estimate(records, range_V, fraction, SOME) if free else ()

    def solve(records: Sequence[Record], **onward: Any) -> Solution:
        return solve_stage(records, *settings, estimated=pasts, **onward)

    try:
        found = solve_stage(records, *settings)
    except (DataError, FitError) as refused:
        if not any(pasts):
            raise
        try:
            found = solve(records)
        except (DataError, FitError):
            raise refused from None
        left = misfits(found.solved.runs, found.solved.residuals_um)
        if found.solved.problem.least_noise_share and any(one.far for one in left):
            raise
    if free and all(pasts_to_estimate(records, range_V, fraction)):
        more = doubted(found.solved.runs, found.solved.residuals_um)
        pasts = tuple(map(or_, pasts, more))
    # Of what else a stage without its resonance leaves no past is to blame.
    if not any(pasts) or (found.solved.problem.least_noise_share and not any(found.plan.estimated)):
        return found
    if found.plan.estimated != pasts:
        progress("again with all samples, and what unknown pasts add to them")
        found = solve(records, onward=found.solved.onward) if found.failure is None else solve(records)
    if found.failure is not None:
        return found

    def again(**further: Any) -> Solution:
        before = {"onward": found.solved.onward, "strides": [run.stride for run in found.solved.runs]}
        return solve(records, movable=False, **before, **further)

    for _ in range(TURNS):
        begun = as_begun(found.solved.stage, found.solved.runs)
        if found.failure is not None or not differ([run.record for run in found.solved.runs], begun):
            break
        progress("again with what went on before the runs")
        records = begun
        found = again()
    weights = weights_beside_pasts(found.solved.runs, found.solved.residuals_um)
    if found.failure is None and loss == "squares" and min(map(np.min, weights)) < 1:
        progress("again, where unknown pasts count with less weight")
        found = again(weights=weights)
    return found


def solve_stage(
    records: Sequence[Record],
    stage: m.Stage | None,
    levels: int | None,
    holdout: float | Sequence[Record],
    initial: str | Sequence[str],
    loss: str,
    progress: Progress,
    finest: int = LADDER[-1],
    accept_best: bool = False,
    estimated: Sequence[bool] = (),
    onward: Problem | None = None,
    holds: Sequence[m.Hold] = (),
    movable: bool | None = None,
    weights: Sequence[np.ndarray] = (),
    strides: Sequence[int] = (),
) -> Solution:
    """Fit a stage, on a grid of at most the finest levels; see `fit_stage`.

    `accept_best` takes the best place for an answer where the fit does not become stationary. What an unknown past
    adds is `estimated` beside the rest for some records: of those given, or of any that would lose most of its
    samples to it. The fit goes `onward` from another one, or begins where the runs say. Commands run between samples
    as the stage says, or each as one of `holds`. The lag is `movable` behind the hysteresis unless a stage is given.
    The samples of each record count as `weights` say, shape `(n,)`, and steps between them go on from the `strides`.
    """
    fraction, _, range_V = check_fit(records, holdout, loss, levels)
    for record in records:
        refuse_many_steps(record, 1)
    states = [initial] * len(records) if isinstance(initial, str) else list(initial)
    if len(states) != len(records):
        raise DataError(f"{len(states)} initial states were given for {len(records)} runs: give one, or one each")
    movable = stage is None if movable is None else movable
    stage = default_stage() if stage is None else stage
    if not estimated and free_grid(stage) is not None and set(states) == {"unknown"}:
        estimated = pasts_to_estimate(records, range_V, fraction, MOST)
    ahead = stage.parts[: place_of_hysteresis(stage)]
    if stage.hold == "zero" and not any(isinstance(part, m.Driver) for part in ahead):
        raise DataError(
            "the stage holds its command in steps, which is fitted only with a driver ahead of the hysteresis: "
            "insert one, or use hold='first'"
        )
    plan = Plan(
        *(tuple(records), tuple(states), fraction, range_V, loss, progress, gain_ahead(stage)),
        tuple(holds) or (stage.hold,) * len(records),
        accept_best=accept_best,
        estimated=tuple(estimated),
        weights=tuple(weights),
        movable=movable,
    )
    if onward is not None:
        problem = placed_onward(plan, onward) if movable else onward
    elif starts_as_it_is(stage):
        if levels is not None:
            raise DataError(f"levels is {levels}, and the stage has no hysteresis on a grid: leave it out")
        plan, problem = present_problem(plan, stage)
    else:
        problem = start_problem(plan, stage, levels, finest)
    found = _refined(plan, problem, strides)
    settled = plan.behind(found.solved)
    if settled is None:
        return found
    progress("again without what an unknown past reaches behind the lag")
    return _refined(settled, found.solved.onward, [run.stride for run in found.solved.runs])


def _refined(plan: Plan, problem: Problem, strides: Sequence[int]) -> Solution:
    try:
        return Solution(*refine_problem(plan, problem, strides), plan)
    except FitError as failure:
        if plan.accept_best:
            raise
        # What the best place leaves may show why.
        return Solution(*refine_problem(replace(plan, accept_best=True), problem, strides), plan, failure)
