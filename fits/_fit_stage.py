"""From slow and fast records to a whole fitted stage."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np

from fits._errors import DataError
from fits._fit import LADDER, choose_grid
from fits._prior import Hyper
from fits._record import Record, refuse_repeats
from fits._result import FitError, FitStatus
from fits._run import prepare_run, simulate_run
from fits._stage_checks import compare_gains, refuse_slopes, refuse_unseen
from fits._stage_moments import Chain
from fits._stage_result import StageFit
from fits._stage_run import StageRun, gain_ahead, place_of_hysteresis, prepare_stage_run, simulate_stage
from fits._stage_solve import LOSSES, Solved, solve_chain
from fits._stage_start import measure_response, start_stages
from fits._stage_summary import summarise
from fits._stage_uncertainty import Precision, offsets_out
from microid import Driver, GridDensity, Hold, Mechanics, Preisach, Reversible, Stage

# Runs whose voltage moves less than this many times faster than that of the slowest are slow.
_SLOW = 4.0
# Intervals are divided until the error of the finite step moves no parameter by this many standard deviations.
_BIAS = 0.15
_FINEST = 16
# Parts of the sampling interval below which a driver has no time constant, and from which it may find one again.
_ASLEEP, _WAKE = 1e-2, 0.3


def default_stage(hold: Hold = "first") -> Stage:
    """The stage of Section 3.1: driver, Preisach operator and mechanics, with all gain in the operator.

    A gain anywhere else would only be seen together with it.

    Parameters
    ----------
    hold
        How the command runs between samples: `first` for lines, `smooth` for curves, `zero` for steps that each begin
        at a sample and are not seen by it yet.
    """
    flat = Preisach(
        GridDensity(jnp.full(10, 0.1), jnp.asarray(0.0), jnp.asarray(1.0)),
        Reversible(jnp.ones(4), jnp.asarray(0.0), jnp.asarray(1.0)),
        jnp.asarray(0.0),
    )
    stage = Stage.of(
        hold=hold,
        driver=Driver(jnp.asarray(1e-3)),
        hysteresis=flat,
        mechanics=Mechanics(jnp.asarray(100.0), jnp.asarray(0.1)),
    )
    return stage.freeze("driver.gain", "mechanics.gain")


def fit_stage(
    records: Sequence[Record],
    *,
    stage: Stage | None = None,
    levels: int | None = None,
    holdout: float | Sequence[Record] = 0.2,
    initial: str | Sequence[str] = "unknown",
    loss: str = "squares",
    progress: Callable[[str], None] = lambda _: None,
) -> StageFit:
    """Fit driver, hysteresis and mechanics jointly to slow and fast runs of one rig.

    The slow runs give a first hysteresis, what the fast ones make of it a frequency response, and that the poles to
    start from. Then all runs are fitted together: the hysteresis is a smooth non-negative regression as in `fit`,
    solved for exactly while the other parameters follow damped Gauss-Newton steps.

    Parameters
    ----------
    records
        Runs of one rig, at whatever rates. Each has its own sensor offset.
    stage
        What is fitted: all its parameters that are not frozen. A `Preisach` operator on a grid is fitted as `fit`
        does, whatever its present values; drivers and mechanics start from the data; other parts start from their
        present values. By default the stage of `default_stage`.
    levels
        Number of switching voltages; chosen from the slow runs by default.
    holdout
        Fraction at the end of every run that is only predicted, or records that are.
    initial
        Memory before each run: `unknown`, `negative`, `positive` or `demagnetised`. One for all holds for records
        that are held out, too; theirs is unknown where each fitted run has its own.
    loss
        `squares`, or `huber`, to which outliers count less.
    progress
        Told what is being done, a sentence at a time.

    Returns
    -------
    StageFit
        Never the start: a fit that fails raises.

    Raises
    ------
    DataError
        If the records cannot be fitted, do not show the dynamics, or are not of one rig.
    FitError
        If a solver fails.
    RuntimeError
        If JAX computes in single precision.
    """
    asked = stage, levels, holdout, initial, loss, progress
    found = solve_stage(records, *asked)
    progress("comparing with the measurement")
    aside = () if isinstance(holdout, int | float) else tuple(holdout)
    before = initial if isinstance(initial, str) else "unknown"
    chain = found.chain
    settings = before, 1.0, found.solved.runs[-1].samples.stride, gain_ahead(found.stage), found.stage.hold
    held = [prepare_stage_run(record, found.range_V, *settings) for record in aside]
    summary = summarise(found.stage, chain.coordinates, found.solved, found.precision, held)
    notes = [warning for record in (*records, *aside) for warning in record.warnings]
    return replace(summary, remarks=(*notes, *found.remarks, *summary.remarks))


@dataclass(frozen=True)
class Solution:
    """What the fit of a stage found, before it is compared with anything.

    Attributes
    ----------
    stage
        The fitted stage, without an offset.
    chain
        The same in the coordinates of its fit.
    solved
        Where the fit ended.
    precision
        How sure it is.
    stroke_um
        Unit of the columns of the grid.
    range_V
        Range of the commands.
    remarks
        What the user should know, one sentence each.
    """

    stage: Stage
    chain: Chain
    solved: Solved
    precision: Precision
    stroke_um: float
    range_V: tuple[float, float]
    remarks: tuple[str, ...]


def solve_stage(
    records: Sequence[Record],
    stage: Stage | None,
    levels: int | None,
    holdout: float | Sequence[Record],
    initial: str | Sequence[str],
    loss: str,
    progress: Callable[[str], None],
    finest: int = LADDER[-1],
    anyway: bool = False,
) -> Solution:
    """Fit a stage, on a grid of at most the finest levels; other arguments and errors are those of `fit_stage`.

    `anyway` takes the best place for an answer where the fit does not become stationary.
    """
    if not jax.config.read("jax_enable_x64"):
        raise RuntimeError('estimation needs float64: jax.config.update("jax_enable_x64", True)')
    if loss not in LOSSES:
        raise DataError(f"unknown loss {loss!r}: choose one of {', '.join(LOSSES)}")
    if not records:
        raise DataError("there is no record to fit")
    aside = () if isinstance(holdout, int | float) else tuple(holdout)
    refuse_repeats([*records, *aside])
    states = [initial] * len(records) if isinstance(initial, str) else list(initial)
    if len(states) != len(records):
        raise DataError(f"{len(states)} initial states were given for {len(records)} runs: give one, or one each")
    fraction = float(holdout) if isinstance(holdout, int | float) else 0.0
    if not 0 <= fraction <= 0.9:
        raise DataError(f"the fraction held out is {fraction:g}: choose it between 0 and 0.9")
    voltages = [record.voltage_V for record in (*records, *aside)]
    range_V = min(float(v.min()) for v in voltages), max(float(v.max()) for v in voltages)
    stage = default_stage() if stage is None else stage
    ahead = stage.parts[: place_of_hysteresis(stage)]
    if stage.hold == "zero" and not any(isinstance(part, Driver) for part in ahead):
        raise DataError(
            "the stage holds its command in steps, which is fitted only with a driver ahead of the hysteresis: "
            "insert one, or use hold='first'"
        )
    plan = _Plan(
        tuple(records), tuple(states), fraction, range_V, loss, progress, gain_ahead(stage), stage.hold, anyway
    )
    problem = _start(plan, stage, levels, finest)
    problem, solved, precision = _refine(plan, problem)
    fitted = problem.at(solved)
    return Solution(fitted, problem.chain, solved, precision, problem.stroke_um, range_V, problem.remarks)


@dataclass(frozen=True)
class _Plan:
    """What was asked for."""

    records: tuple[Record, ...]
    states: tuple[str, ...]
    fraction: float
    range_V: tuple[float, float]
    loss: str
    progress: Callable[[str], None]
    gain: float | None
    hold: Hold
    anyway: bool

    def runs(self, stride: int) -> list[StageRun]:
        """The records, each interval divided into so many steps."""
        return [
            prepare_stage_run(record, self.range_V, state, self.fraction, stride, self.gain, self.hold)
            for record, state in zip(self.records, self.states, strict=True)
        ]


@dataclass(frozen=True)
class _Problem:
    """A stage to be fitted, and where its fit begins."""

    stage: Stage
    chain: Chain
    z: np.ndarray
    columns_um: np.ndarray
    hyper: Hyper | None
    stroke_um: float
    remarks: tuple[str, ...]

    def at(self, solved: Solved) -> Stage:
        """The stage that a solution stands for."""
        return self.chain.stage(jnp.asarray(solved.z), jnp.asarray(solved.columns_um))


def _start(plan: _Plan, stage: Stage, levels: int | None, finest: int) -> _Problem:
    """Read a hysteresis off the slow runs and poles off the others."""
    speed = [_speed_Hz(record) for record in plan.records]
    slow = [k for k, one in enumerate(speed) if one <= _SLOW * min(speed)]
    place = place_of_hysteresis(stage)
    law = None if place is None else stage.parts[place]
    grid, columns, hyper, stroke = None, np.zeros(0), None, 1.0
    drives = [record.voltage_V for record in plan.records]
    name = stage.names[place or 0]
    if isinstance(law, Preisach) and isinstance(law.density, GridDensity) and name not in stage.frozen:
        refuse_slopes([plan.records[k] for k in slow])
        loose = [stage.named(row.path) for row in offsets_out(stage, True).table if row.path.endswith(".gain")]
        if loose:
            raise DataError(
                f"{', '.join(loose)} and the weights of {name} are both free, but only their product is seen, "
                f"not each: freeze {loose[0]}, or the {name}"
            )
        assert plan.gain is not None
        lower, upper = plan.gain * plan.range_V[0], plan.gain * plan.range_V[1]
        runs = [
            prepare_run(replace(record, voltage_V=plan.gain * record.voltage_V), lower, upper, state, plan.fraction)
            for record, state in zip(plan.records, plan.states, strict=True)
        ]
        plan.progress(f"hysteresis from {', '.join(plan.records[k].source for k in slow)}")
        stroke, tried, _ = choose_grid([runs[k] for k in slow], levels, plan.progress, finest)
        grid, hyper = tried.data.grid, tried.solution.hyper
        columns = np.asarray(tried.solution.columns) * stroke
        law = grid.model(columns, np.zeros(()))
        stage = stage.swap(name, law)
        drives = [simulate_run(law, run) for run in runs]
    elif law is not None:
        drives = [np.asarray(law(jnp.asarray(record.voltage_V))) for record in plan.records]  # type: ignore[operator]
    runs_at_rate = plan.runs(1)
    lively = [k for k in range(len(plan.records)) if k not in slow] or slow
    responses = [measure_response(runs_at_rate[k], drives[k]) for k in lively]
    candidates = start_stages(stage, responses)
    place = place if grid is not None else None
    best: tuple[float, Stage, Chain, Solved] | None = None
    failure = FitError(FitStatus.NONFINITE)
    for number, candidate in enumerate(candidates):
        plan.progress(f"poles: start {number + 1} of {len(candidates)}")
        chain = Chain(offsets_out(candidate, grid is not None), place, grid)
        z = np.asarray(chain.coordinates.of(candidate))
        try:
            solved = solve_chain(chain, z, columns, runs_at_rate, None, stroke, plan.loss, plan.progress, rough=True)
        except FitError as error:
            failure = error
            continue
        cost = solved.cost
        if best is None or cost < best[0]:
            best = cost, candidate, chain, solved
    if best is None:
        raise failure
    _, stage, chain, solved = best
    found = chain.stage(jnp.asarray(solved.z), jnp.asarray(columns))
    refuse_unseen(found, chain.coordinates, solved, drives, fast=lively != slow)
    remarks = compare_gains(found, runs_at_rate)
    return _Problem(stage, chain, solved.z, columns, hyper, stroke, tuple(remarks))


def _speed_Hz(record: Record) -> float:
    """Frequency of a sine that moves as fast as a voltage does, for its size."""
    rate = np.diff(record.voltage_V) / np.diff(record.time_s)
    size = float(np.std(record.voltage_V))
    if size == 0:
        raise DataError(f"{record.source}: the voltage does not move; there is nothing to fit")
    return float(np.sqrt(np.mean(rate**2))) / (2 * np.pi * size)


def _refine(plan: _Plan, problem: _Problem) -> tuple[_Problem, Solved, Precision]:
    """Fit, and fit again with the intervals divided if the finite step moves a parameter noticeably."""
    stride = 1
    while True:
        runs = plan.runs(stride)
        start = problem.z, problem.columns_um, runs, problem.hyper, problem.stroke_um
        solved = solve_chain(problem.chain, *start, plan.loss, plan.progress, anyway=plan.anyway)
        problem = replace(problem, z=solved.z, columns_um=solved.columns_um, hyper=solved.hyper)
        precision = Precision(problem.chain, solved, problem.stroke_um)
        if plan.gain is None or stride > 1:
            return problem, solved, precision
        influence, stage = precision.influence(), problem.at(solved)
        sd = np.sqrt(np.diagonal(precision.covariance(influence)))
        off = [simulate_stage(stage, a) - simulate_stage(stage, b) for a, b in zip(runs, plan.runs(2), strict=True)]
        moved = [own @ (o - o[run.fitted].mean()) for own, o, run in zip(influence, off, runs, strict=True)]
        # Halving the step takes three quarters of its error off, which falls with its square.
        excess = float(np.max(np.abs(np.sum(moved, axis=0)) / sd)) / (0.75 * _BIAS)
        if excess <= 1:
            return problem, solved, precision
        stride = min(_FINEST, 2 ** math.ceil(math.log2(excess) / 2))
        plan.progress(f"{stride} steps per sample")
        problem = replace(problem, z=_awake(plan, problem, solved))


def _awake(plan: _Plan, problem: _Problem, solved: Solved) -> np.ndarray:
    """Coordinates to go on from in finer steps: with a driver that is as slow again as they show.

    A command that jumps at every sample has all of the driver's answer between two: whole steps do not see it, and
    from no time constant at all there is no way back.
    """
    stage = problem.at(solved)
    interval_s = min(float(np.median(np.diff(record.time_s))) for record in plan.records)
    changed = False
    for name, part in zip(stage.names, stage.parts, strict=True):
        if isinstance(part, Driver) and float(part.time_constant_s) < _ASLEEP * interval_s:
            stage = stage.swap(name, replace(part, time_constant_s=jnp.asarray(_WAKE * interval_s)))
            changed = True
    if plan.hold != "zero" or not changed:
        return solved.z
    return np.asarray(problem.chain.coordinates.of(stage))
