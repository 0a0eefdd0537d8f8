"""The plain stage that a diagnosis starts from, fitted to all runs, and its simulation."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import get_args

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from fits.io._errors import DataError
from fits.io._record import Record
from fits.io.columns.path import PATH, gone_V
from fits.loop._choose_grid import choose_grid
from fits.loop._known import pasts_to_estimate
from fits.loop._prior import Hyper, roughness
from fits.loop._result import FitError
from fits.loop._run import Run, prepare_run
from fits.stage._began import TURNS, as_begun, differ
from fits.stage._chain import Chain
from fits.stage._checks import BESIDE_A_LAG, OR_ALONE
from fits.stage._information import prior_precision
from fits.stage._motion import at_samples, prepare, signals
from fits.stage._run import named_parts
from fits.stage._solve import Problem
from fits.stage._solve_stage import Solution, default_stage, solve_stage
from fits.stats._noise import rough_noise_um
from microid import Driver, Hold, Mechanics, Preisach, Stage
from microid.effects import AbstractEffect, extend, host

# What a finer grid would follow has a prior of its own in the projection.
_FINEST = 32
# Steps between samples in which effects are simulated, at most.
_COARSE = 4
# Steps between samples in which the plain stage is simulated where those of its fit are off by more than this, in
# all samples together, in noise.
_FINE, _LARGEST_DIFFERENCE = 16, 1.0
# What shows of another way of the command is as large as that way makes it, within this part.
_AS_LARGE = 0.25


class Fixed(eqx.Module):
    """Coordinates of a stage of which only the grid is fitted."""

    stage: Stage
    size: int = eqx.field(static=True, default=0)

    def __call__(self, _: object) -> Stage:
        """The stage."""
        return self.stage


@dataclass(frozen=True)
class Baseline:
    """A fitted plain stage, and the runs prepared with several numbers of steps between samples.

    `chain` holds its coordinates, `z` and `columns_um` (um) where the fit ended, and `prior` the precision of the
    columns before the data (1/um^2, shape `(D, D)`), which the smoothness `hyper` makes, if that was estimated.
    `aside` are whole runs that are held out; of `runs` a part is. Of both there are copies: `coarse` with few steps,
    enough for what effects change; `finest` with many; `fine` with so many that the plain stage is exact within the
    noise. `dynamic` says whether driver and mechanics were fitted, `skewed` that the readings of a run may be late
    or early by a small part of the sampling interval, and `blurred` that instants jitter, so that in the mean a run
    reads its second derivative, too.
    """

    chain: Chain
    z: np.ndarray
    columns_um: np.ndarray
    prior: np.ndarray
    stroke_um: float
    range_V: tuple[float, float]
    runs: tuple[Run, ...]
    aside: tuple[Run, ...]
    coarse: tuple[Run, ...]
    coarse_aside: tuple[Run, ...]
    finest: tuple[Run, ...]
    finest_aside: tuple[Run, ...]
    fine: tuple[Run, ...]
    fine_aside: tuple[Run, ...]
    dynamic: bool
    remarks: tuple[str, ...]
    problem: Problem | None = None
    hyper: Hyper | None = None
    skewed: bool = False
    blurred: bool = False

    @property
    def stage(self) -> Stage:
        """The fitted stage, without an offset."""
        return self.chain.stage(jnp.asarray(self.z), jnp.asarray(self.columns_um))

    @property
    def resonance_Hz(self) -> float | None:
        """Of the fitted stage; None without mechanics."""
        mechanics = [part for part in self.stage.parts if isinstance(part, Mechanics)]
        return float(mechanics[0].natural_frequency_Hz) if mechanics else None

    def moved(self, dz: np.ndarray, dcolumns_um: np.ndarray | float) -> "Baseline":
        """The same at other coordinates and columns."""
        return replace(self, z=self.z + dz, columns_um=self.columns_um + dcolumns_um)

    def with_driver_alone(self, lag_s: float) -> Problem:
        """Its hysteresis behind a driver that lags so, and no mechanics: where a fit of that begins."""
        [(name, hysteresis)] = named_parts(self.stage, Preisach)
        driver = Driver(jnp.asarray(lag_s))
        stage = Stage((driver, hysteresis), ("driver", name), hold=self.stage.hold).freeze("driver.gain")
        return Problem.of(stage, self.chain.grid, self.columns_um, self.hyper, self.stroke_um)

    def held_aside(self, hold: Hold) -> "Baseline":
        """The same, the commands of all runs held out whole going between samples in this way."""
        each = self.aside, self.coarse_aside, self.finest_aside, self.fine_aside
        aside, coarse, finest, fine = (tuple(replace(run, hold=hold) for run in runs) for runs in each)
        return replace(self, aside=aside, coarse_aside=coarse, finest_aside=finest, fine_aside=fine)

    def alone(self, run: Run) -> "Baseline":
        """The same with one run only; what is known of the columns beforehand counts with the others."""
        made, none = (run,), ()
        here = replace(self, prior=np.eye(1), runs=made, coarse=made, finest=made, fine=made)
        return replace(here, aside=none, coarse_aside=none, finest_aside=none, fine_aside=none)


def simulate(stage: Stage, run: Run) -> np.ndarray:
    """Response of a stage to a run that is refined already, in um, shape `(n,)`."""
    prepared = prepare(stage, run)
    return at_samples(signals(stage.with_substeps(1), prepared)[-1], prepared)


def with_effects(stage: Stage, effects: Sequence[AbstractEffect]) -> Stage:
    """Put effects into a stage, those that act on a part around that part."""
    for effect in effects:
        place = host(type(effect), stage)
        own = effect if place is None else replace(effect, inner=stage.parts[place])  # type: ignore[call-arg]
        stage = extend(stage, own)
    return stage


def fit_baseline(
    records: Sequence[Record],
    aside: Sequence[Record],
    holdout: float,
    initial: str,
    progress: Callable[[str], None],
    holds: Sequence[Hold] = (),
    better: float = np.inf,
    onward: Problem | None = None,
    left_out: tuple[str, ...] = (),
) -> Baseline:
    """Fit the plain stage: with driver and mechanics where the runs show them, quasi-static otherwise.

    `holds` say how the commands of `records` run between samples, as in `Stage`, in lines by default. Those of
    `aside` run as the fastest of these, unless that part of their error goes otherwise. The fit goes `onward` from
    one that was made. `left_out` says why driver and mechanics are left out, where that is known already.

    Raises
    ------
    DataError, FitError
        If neither can be fitted.
    """
    records, aside = with_paths(records, aside)
    settings = holdout, initial, progress, holds, better
    found = _fitted(records, aside, *settings, onward, left_out)
    for _ in range(TURNS if found.dynamic else 0):
        runs = *found.runs, *found.aside
        begun = as_begun(found.stage, runs)
        if not differ([run.record for run in runs], begun):
            break
        progress("again with what went on before the runs")
        found = _fitted(begun[: len(records)], begun[len(records) :], *settings, found.problem, left_out)
    return found


def _fitted(
    records: Sequence[Record],
    aside: Sequence[Record],
    holdout: float,
    initial: str,
    progress: Callable[[str], None],
    holds: Sequence[Hold],
    better: float,
    onward: Problem | None,
    left_out: tuple[str, ...],
) -> Baseline:
    voltages = [record.voltage_V for record in (*records, *aside)]
    range_V = min(float(v.min()) for v in voltages), max(float(v.max()) for v in voltages)
    remarks: tuple[str, ...] = ()
    lines: list[Hold] = ["first"] * len(records)
    holds = holds or lines
    # What is fastest shows best how commands go on.
    rates = [np.diff(record.voltage_V) / np.diff(record.time_s) for record in records]
    hold = holds[int(np.argmax([np.mean(rate**2) for rate in rates]))]
    past = pasts_to_estimate(records, range_V, holdout)
    past_aside = (any(past),) * len(aside)
    if left_out:
        return _static(records, aside, range_V, holdout, initial, past, left_out, progress)
    try:
        # Steps are fitted only behind a driver.
        usable = onward is not None and ("zero" not in holds or bool(named_parts(onward.stage, Driver)))
        near = onward.held(hold) if onward is not None and usable else None
        stage = default_stage(hold) if near is None else near.stage
        settings = records, stage, None, holdout, initial, "squares", progress, _FINEST
        solve = partial(solve_stage, *settings, accept_best=True, holds=holds)
        # A lag may have been looked for behind another command.
        movable = near is None or (onward is not None and onward.stage.hold != hold)
        if near is None and any(past):
            near = _without_pasts(solve)
        found = solve(estimated=past, onward=near, movable=movable)
    except (DataError, FitError) as error:
        # That is what is done.
        why = str(error).removesuffix(BESIDE_A_LAG).removesuffix(f", {OR_ALONE}")
        remarks = (f"driver and mechanics are left out, the stage is taken as quasi-static: {why}",)
        return _static(records, aside, range_V, holdout, initial, past, remarks, progress)
    solved, chain, stroke_um = found.solved, found.solved.problem.chain, found.solved.problem.stroke_um
    prior = prior_precision(chain, solved.hyper, stroke_um)
    strides = [run.stride for run in solved.runs]

    def prepared(least: int, most: int) -> tuple[tuple[Run, ...], tuple[Run, ...]]:
        many = [int(np.clip(stride, least, most)) for stride in strides]
        held = _prepared(aside, range_V, initial, 0.0, [max(many)] * len(aside), past_aside, held_holds)
        return _prepared(records, range_V, initial, holdout, many, past, holds), held

    # A run whose history is unknown to its end says little of that, and is no error.
    asked = _prepared(aside, range_V, initial, 1.0, [_FINE] * len(aside), (False,) * len(aside))
    held_holds = [_hold_of(solved.stage, run, better) for run in asked]
    (runs, held), (finest, finest_held) = prepared(1, max(strides)), prepared(_FINE, max(*strides, _FINE))
    # Behind a step a reading has corners that whole steps do not show to what reads it between samples.
    few = _COARSE if "zero" in (*holds, *held_holds) else 1
    return Baseline(
        *(chain, solved.z, solved.columns_um, prior, stroke_um, range_V, runs, held),
        *prepared(few, _COARSE),
        *(finest, finest_held),
        tuple(map(partial(_with_enough_steps, solved.stage), runs, finest)),
        tuple(map(partial(_with_enough_steps, solved.stage), held, finest_held)),
        dynamic=True,
        remarks=solved.problem.remarks,
        problem=solved.onward,
        hyper=solved.hyper,
    )


def _without_pasts(solve: Callable[..., Solution]) -> Problem | None:
    """Fit what depends on no unknown past, where that is most, to go on from; None where that fails."""
    try:
        return solve(movable=False).solved.onward
    except (DataError, FitError):
        return None


def with_paths(records: Sequence[Record], aside: Sequence[Record]) -> tuple[Sequence[Record], Sequence[Record]]:
    """Say of each record how far the command had gone before, if they were taken one after the other."""
    if len(records) + len(aside) < 2 or all(PATH in record.extra for record in (*records, *aside)):
        return records, aside
    gone, out = 0.0, []
    for record in (*records, *aside):
        path_V = gone + gone_V(record.voltage_V)
        gone = float(path_V[-1])
        out.append(replace(record, extra={**record.extra, PATH: path_V}))
    return out[: len(records)], out[len(records) :]


def _prepared(
    records: Sequence[Record],
    range_V: tuple[float, float],
    initial: str,
    holdout: float,
    strides: Sequence[int],
    estimated: Sequence[bool],
    holds: Sequence[Hold] = (),
) -> tuple[Run, ...]:
    lines: list[Hold] = ["first"] * len(records)
    each = zip(records, strides, holds or lines, estimated, strict=True)
    settings = range_V, initial, holdout
    return tuple(prepare_run(one, *settings, stride, hold=hold, estimated=past) for one, stride, hold, past in each)


def _hold_of(stage: Stage, run: Run, least: float) -> Hold:
    """How the command of a run seems to go between samples, by what a stage that was fitted to others predicts.

    As in the others unless another way takes off the least part of the fast changes that are left, and they are as
    large as that way makes them; slow errors of the stage are small there. What else comes late, as behind a slew
    limit, is late by another amount.
    """
    way: dict[Hold, np.ndarray] = {
        hold: np.diff(simulate(stage, replace(run, hold=hold))[run.known]) for hold in get_args(Hold)
    }
    left = np.diff(run.displacement_um[run.known]) - way[stage.hold]
    best, found = stage.hold, (1 - least) * float(left @ left)
    for hold, moved in way.items():
        change = moved - way[stage.hold]
        size = float(left @ change) / max(float(change @ change), 1e-300)
        if abs(size - 1) < _AS_LARGE and (cost := float(np.sum((left - change) ** 2))) < found:
            best, found = hold, cost
    return best


def _with_enough_steps(stage: Stage, run: Run, finer: Run) -> Run:
    """Divide intervals into many steps where a simulation with those of the fit is off by more than chance."""
    if run.samples.stride >= finer.samples.stride:
        return run
    better = simulate(stage, finer)
    noise_um = max(rough_noise_um(run.displacement_um - better), 1e-9 * float(np.ptp(run.displacement_um)))
    off = float(np.linalg.norm((better - simulate(stage, run))[run.fitted]))
    return finer if off > _LARGEST_DIFFERENCE * noise_um else run


def _static(
    records: Sequence[Record],
    aside: Sequence[Record],
    range_V: tuple[float, float],
    holdout: float,
    initial: str,
    past: Sequence[bool],
    remarks: tuple[str, ...],
    progress: Callable[[str], None],
) -> Baseline:
    ready, held = (
        _prepared(records, range_V, initial, holdout, [1] * len(records), past),
        _prepared(aside, range_V, initial, 0.0, [1] * len(aside), (any(past),) * len(aside)),
    )
    stroke, tried, _ = choose_grid(list(ready), None, progress, _FINEST)
    grid = tried.data.grid
    columns = np.asarray(tried.solution.columns) * stroke
    stage = Stage.of(hysteresis=grid.model(columns, np.zeros(())))
    chain = Chain(Fixed(stage), 0, grid)  # type: ignore[arg-type]
    prior = np.asarray(roughness(grid.levels).precision(tried.solution.hyper)) / stroke**2
    same, hyper = (ready, held) * 4, tried.solution.hyper
    return Baseline(
        *(chain, np.zeros(0), columns, prior, stroke, range_V, *same), dynamic=False, remarks=remarks, hyper=hyper
    )
