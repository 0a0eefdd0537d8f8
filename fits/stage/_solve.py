"""Fitting a whole stage: damped Gauss-Newton steps, the columns of the hysteresis solved for exactly in each."""

import operator
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from fits.io._threads import map_in_threads
from fits.loop._design import Grid
from fits.loop._grid import solve_grid
from fits.loop._moments import Data, Moments
from fits.loop._prior import Hyper
from fits.loop._result import FitError, FitStatus
from fits.loop._run import Progress, Run
from fits.stage._chain import Chain
from fits.stage._information import marginal_information, prior_precision, scale_free
from fits.stage._moments import RunSums, run_sums, split_moments
from fits.stage._run import residual_of
from fits.stats._noise import correlation_samples, huber_weight
from microid import Hold, Stage

_ROUNDS, _ROUGH = 40, 12
# Marquardt's damping at first, what a step that fails multiplies it by, and where it gives up.
_FIRST, _FACTOR, _HIGHEST = 1e-4, 10.0, 1e6
# Part of what the linearisation says of the gain of a step, below which that is not trusted so far.
_WORTH = 0.5
# A fit has converged where the optimum is nearer than this many standard deviations per coordinate.
_STATIONARY = 0.02
# A run is given up where this many times as much is left of it, since neighbouring samples of it agree.
_GIVEN_UP = 2.0
# For those who go on from the best place, the logarithm of the likelihood must rise by this much in so many rounds.
_FALLS, _PATIENCE = 0.5, 6


@dataclass(frozen=True)
class Weighing:
    """How much a sample of each run counts, by the standard deviation of the run's residual.

    So many samples as `correlation` are worth one independent one; `counted` is the same as the samples are counted.
    Where more than noise is left, one run would be fitted ever better, and count ever more, at the cost of others:
    none counts as quieter than the part `least_noise_share` of the loudest.
    """

    noise_um: tuple[float, ...]
    correlation: tuple[float, ...]
    counted: tuple[float, ...]
    least_noise_share: float = 0.0

    @classmethod
    def of(cls, runs: Sequence[Run], residuals: Sequence[np.ndarray], *counted: float) -> "Weighing":
        """Weigh runs by what a fit leaves of them, all equally correlated unless `counted` is given."""
        noise, correlation = [], []
        for run, residual in zip(runs, residuals, strict=True):
            left = residual[run.fitted]
            noise.append(float(np.sqrt(np.average(left**2, weights=run.fit_weight[run.fitted]))))
            correlation.append(correlation_samples([run.weighed(residual)[run.fitted]]))
        each = float(np.exp(np.mean(np.log(correlation))))
        return cls(tuple(noise), tuple(correlation), counted or (each,) * len(noise))

    def gives_up(self, other: "Weighing") -> bool:
        """Whether some run is left much more of than by another fit, as where a model is wrong for it."""
        return any(now > _GIVEN_UP * then for now, then in zip(self.noise_um, other.noise_um, strict=True))

    def alike(self) -> "Weighing":
        """As if all runs had the same noise, and no sample any of another."""
        noise = (float(np.sqrt(np.mean(np.square(self.noise_um)))),) * len(self.noise_um)
        return replace(self, noise_um=noise, counted=(1.0,) * len(noise))

    @property
    def least_um(self) -> float:
        """The smallest noise, in which the joint problem is measured."""
        return max(min(self.noise_um), self.least_noise_share * max(self.noise_um))

    @property
    def shares(self) -> list[float]:
        """Independent samples of the quietest run that a sample of each run is worth."""
        noises = zip(self.noise_um, self.counted, strict=True)
        return [(self.least_um / max(um, self.least_um)) ** 2 / each for um, each in noises]

    def total(self, sums: Sequence[RunSums]) -> Moments:
        return reduce(operator.add, (one.moments.scaled(k, 1.0) for one, k in zip(sums, self.shares, strict=True)))

    def cost_um2(self, runs: Sequence[Run], residuals: Sequence[np.ndarray]) -> float:
        """Sum of squares that goes with `total`."""
        each = zip(runs, residuals, self.shares, strict=True)
        return sum(share * float(np.sum(run.fit_weight * left**2)) for run, left, share in each)


@dataclass(frozen=True)
class Problem:
    """A stage to be fitted, where its fit begins, and what the user should know.

    The columns' unit is `stroke_um`; `hyper` is the smoothness and noise to start from, None to leave columns as they
    are; for `least_noise_share` see `Weighing`. `full` is the stage before a part was left out.
    """

    stage: Stage
    chain: Chain
    z: np.ndarray
    columns_um: np.ndarray
    hyper: Hyper | None
    stroke_um: float
    remarks: tuple[str, ...] = ()
    least_noise_share: float = 0.0
    full: "Solved | None" = None

    @classmethod
    def of(
        cls, stage: Stage, grid: Grid | None, columns_um: np.ndarray, hyper: Hyper | None, stroke_um: float
    ) -> "Problem":
        """Begin at a stage, and at columns of the grid of its hysteresis."""
        chain = Chain.of(stage, grid)
        return cls(stage, chain, np.asarray(chain.coordinates.of(stage)), columns_um, hyper, stroke_um)

    def held(self, hold: Hold) -> "Problem":
        """The same with the command held in another way between samples."""
        stage = self.chain.stage(jnp.asarray(self.z), jnp.asarray(self.columns_um)).with_hold(hold)
        chain = Chain.of(stage, self.chain.grid)
        return replace(self, stage=stage, chain=chain, z=np.asarray(chain.coordinates.of(stage)))


@dataclass(frozen=True)
class Solved:
    """Where a fit ended: coordinates `(p,)`, columns of the grid `(D,)`, smoothness and noise if there is one.

    The runs have the weights of their samples, and the sums are the regression at the end.
    """

    problem: Problem
    z: np.ndarray
    columns_um: np.ndarray
    hyper: Hyper | None
    runs: list[Run]
    sums: list[RunSums]
    weighing: Weighing

    @property
    def stage(self) -> Stage:
        """The stage that it stands for, without an offset."""
        return self.problem.chain.stage(jnp.asarray(self.z), jnp.asarray(self.columns_um))

    @property
    def onward(self) -> Problem:
        """The problem of going on from here."""
        return replace(self.problem, z=self.z, columns_um=self.columns_um, hyper=self.hyper)

    @property
    def residuals_um(self) -> list[np.ndarray]:
        """Measurement less prediction of each run, its nuisance parameters taken off, shape `(n,)`."""
        return [one.residual_um for one in self.sums]

    @property
    def cost(self) -> float:
        """Logarithm of the noise that is left, times the samples that count: smaller is better."""
        return _cost(self.runs, self.weighing)


def solve_chain(
    problem: Problem,
    runs: list[Run],
    loss: str,
    progress: Progress,
    rough: bool = False,
    accept_best: bool = False,
    like: Solved | None = None,
) -> Solved:
    """Find the most probable coordinates of a stage, and the columns of its grid.

    Each round linearises the stage, eliminates the coordinates from the regression, solves it for non-negative smooth
    columns with the smoothness that maximises the evidence, and damps the step until the true cost falls (variable
    projection; Golub & Pereyra 2003). Without columns these are Levenberg and Marquardt's steps. A library's solver
    would hold the smoothness, the weights of the runs and the columns at zero fixed, which change with every step.

    A `rough` place is only a start for another fit, and need not be stationary. `accept_best` takes the best place
    for an answer, too, for those who go on from there; otherwise a `FitError` says that it did not become stationary.
    """
    chain, stroke_um = problem.chain, problem.stroke_um
    z, columns_um, hyper = problem.z, problem.columns_um, problem.hyper
    damping = _FIRST
    settled: Solved | None = None
    best, last = np.inf, 0
    rounds: list[tuple[tuple[float, ...], Hyper | None]] = []
    counted, known = ((), None) if like is None else (like.weighing.correlation, like.hyper)
    for number in range(_ROUGH if rough else _ROUNDS):
        runs, sums, weighing = _gather(problem, z, columns_um, runs, loss, counted, rough)
        progress(f"  round {number + 1}: residual {', '.join(f'{noise:.4g}' for noise in weighing.noise_um)} um")
        if not np.all(np.isfinite(weighing.noise_um)):
            raise FitError(FitStatus.NONFINITE)
        if settled is not None and weighing.gives_up(settled.weighing):
            return settled
        if (cost := _cost(runs, weighing)) < best - _FALLS:
            best, last = cost, number
        if (rough or accept_best) and number >= last + _PATIENCE:
            # Smoothness and noise take turns.
            break
        rounds.append((weighing.noise_um, hyper))
        if like is not None:
            weighing = replace(weighing, noise_um=like.weighing.noise_um)
        elif number >= last + _PATIENCE:
            # For an answer both are held at their means then, so that there is one objective, which falls.
            turns = rounds[last + 1 : last + 1 + _PATIENCE]
            noises, hypers = zip(*turns, strict=True)
            weighing = replace(weighing, noise_um=tuple(np.exp(np.mean(np.log(noises), axis=0))))
            known = None if hyper is None else jax.tree.map(lambda *logs: np.mean(logs), *hypers)
        # Far from the answer, what a run leaves says nothing of its noise: weighed by it, one run would be given up.
        weights = weighing.alike() if rough else weighing
        total = weights.total(sums)
        here = weights.cost_um2(runs, [one.residual_um for one in sums])
        while True:
            try:
                step, columns, hyper, variance, distance = _step(
                    problem, total, z, columns_um, hyper, weights, damping, known
                )
            except FitError:
                # The columns of a step too far may be out of their solver's reach.
                damping *= _FACTOR
                if damping <= _HIGHEST:
                    continue
                if accept_best and number:
                    return Solved(problem, z, columns_um, hyper, runs, sums, weighing)
                raise
            prior = prior_precision(chain, hyper, stroke_um)
            there = weights.cost_um2(runs, _residuals(chain, z + step, columns, runs))
            old = here / variance + columns_um @ prior @ columns_um
            new = there / variance + columns @ prior @ columns
            if new <= old:
                z, columns_um = z + step, columns
                # A step that gains much less than the linearisation says goes too far (Marquardt 1963).
                damping *= 1 / _FACTOR if old - new > _WORTH * len(step) * distance**2 else _FACTOR
                break
            # Within rounding of the optimum nothing falls any more.
            if distance < _STATIONARY:
                break
            damping *= _FACTOR
            if damping > _HIGHEST:
                break
        if damping > _HIGHEST:
            if rough or accept_best:
                break
            if chain.grid is None:
                raise FitError(FitStatus.NOT_STATIONARY)
            # Where columns meet their bounds the linearisation promises what no step however short has.
            distance, damping = 0.0, _FIRST
        if distance < _STATIONARY and not rough and not counted and len(runs) > 1:
            # What is fitted worse is correlated more: run after run would be given up if this were asked again.
            counted = weighing.correlation
            settled = Solved(problem, z, columns_um, hyper, runs, sums, weighing)
            continue
        if distance < _STATIONARY:
            runs, sums, weighing = _gather(problem, z, columns_um, runs, loss, counted, rough)
            return Solved(problem, z, columns_um, hyper, runs, sums, weighing)
    if rough or accept_best:
        return Solved(problem, z, columns_um, hyper, runs, sums, weighing)
    raise FitError(FitStatus.MAX_STEPS)


def try_chain(problem: Problem, runs: list[Run], *settings: Any, **further: Any) -> Solved | None:
    """Fit as `solve_chain` does; None where that fails."""
    try:
        return solve_chain(problem, runs, *settings, **further)
    except (FitError, np.linalg.LinAlgError):
        return None


def _gather(
    problem: Problem,
    z: np.ndarray,
    columns_um: np.ndarray,
    runs: list[Run],
    loss: str,
    counted: Sequence[float],
    rough: bool,
) -> tuple[list[Run], list[RunSums], Weighing]:
    chain, free = problem.chain, problem.hyper is not None
    if loss != "squares":
        left = _residuals(chain, z, columns_um, runs)
        # Outliers count linearly (Huber).
        runs = [replace(run, weight=huber_weight(one, run.fitted)) for run, one in zip(runs, left, strict=True)]
    place = chain, jnp.asarray(z), jnp.asarray(columns_um)
    # Columns that are not followed between samples promise what they do not hold where a stage rings.
    sums = map_in_threads(lambda run: run_sums(*place, run, free, not rough), runs)
    weighing = Weighing.of(runs, [one.residual_um for one in sums], *counted)
    return runs, sums, replace(weighing, least_noise_share=problem.least_noise_share)


def _cost(runs: Sequence[Run], weighing: Weighing) -> float:
    terms = zip(runs, weighing.noise_um, strict=True)
    return sum(float(run.fitted.sum()) * float(np.log(noise)) for run, noise in terms)


def _residuals(chain: Chain, z: np.ndarray, columns_um: np.ndarray, runs: Sequence[Run]) -> list[np.ndarray]:
    stage = chain.stage(jnp.asarray(z), jnp.asarray(columns_um))
    return map_in_threads(residual_of, [stage] * len(runs), runs)


def _step(
    problem: Problem,
    total: Moments,
    z: np.ndarray,
    columns_um: np.ndarray,
    hyper: Hyper | None,
    weighing: Weighing,
    damping: float,
    known: Hyper | None,
) -> tuple[np.ndarray, np.ndarray, Hyper | None, float, float]:
    """Change of coordinates, columns, their smoothness, noise variance in um^2, and standard deviations moved."""
    chain, stroke_um = problem.chain, problem.stroke_um
    columns, variance, prior, found = columns_um, weighing.least_um**2, None, hyper
    size = 0 if hyper is None else chain.size
    held, step = np.zeros(len(z), dtype=bool), np.zeros(len(z))
    # No linearisation is believed so far: poles would be beyond all lines, and laws lost at a bound.
    most = np.maximum(1.0, 0.5 * np.abs(z))
    while True:
        beside = total.moved(size + np.flatnonzero(held), step[held])
        reduced, answer, follow = split_moments(beside, size, damping)
        if hyper is not None and chain.grid is not None:
            # The smoothness of the round before may be that of what was not fitted then.
            fresh = replace(Hyper.start(), log_variance=hyper.log_variance)
            solution = solve_grid(Data(chain.grid, reduced, (), ()), stroke_um, fresh, known=known)
            columns, found = np.asarray(solution.columns) * stroke_um, solution.hyper
            answer = answer - follow @ columns
        step[~held] = answer
        beyond = np.abs(step) > most
        if not np.any(beyond):
            break
        step, held = np.clip(step, -most, most), held | beyond
    hyper = found
    if hyper is not None and chain.grid is not None:
        variance = float(np.exp(hyper.log_variance)) * stroke_um**2
        if not variance > 1e-20 * stroke_um**2:  # all is rounding below
            # The search for the noise went astray.
            raise FitError(FitStatus.NONFINITE)
        prior = scale_free(prior_precision(chain, hyper, stroke_um), columns)
    information = marginal_information(total, size, prior, variance)
    # However short the damping makes a step, it is far from the optimum where a whole one is long.
    _, whole, back = split_moments(total, size, 0.0)
    whole = whole - back @ columns[:size]
    return step, columns, hyper, variance, max(float(whole @ information @ whole) / len(step), 0.0) ** 0.5
