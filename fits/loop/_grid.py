"""Fitting the weights of a grid: a smooth, non-negative regression, convex and therefore without a start."""

import operator
from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce

import jax
import numpy as np
import scipy

from fits.loop._moments import Data, blocks_of
from fits.loop._prior import (
    Hyper,
    Posterior,
    effective,
    interpolation,
    inverse,
    maximise_evidence,
    renew_noise,
    roughness,
)
from fits.loop._result import FitError, FitStatus
from fits.loop._run import Run
from fits.loop._surface import Surface
from fits.stats._noise import shared_square
from fits.stats._nonnegative import pivot_nonnegative
from microid import Preisach

# The smoothness is a property of the density, not of the grid: this many levels are enough to find it.
EVIDENCE_LEVELS = 16
# And this many to say how sure predictions are; finer perturbations move no displacement. Here and above the prior
# is that of the coarse grid itself: what is alike along its diagonal is not so where it is read off between nodes.
BELIEF_LEVELS = 24
_ATOL = 1e-6
# Steps of pivoting, and how many where more columns than this, those of 45 levels, make each take long.
_STEPS, _FEW_STEPS, _SOON = 500, 50, 1100
# By so many e-folds the smoothness may differ from what the evidence has.
_FARTHEST = 14.0


@dataclass(frozen=True)
class Estimate:
    """What every family's solver hands over: a model in um, with no offset, how sure it is, and what it leaves.

    `factor_um @ factor_um.T` is the covariance of the columns of the model's grid. `noise_um` is the standard
    deviation of the residual, of which so many samples as `correlation` are worth one independent one.
    `discrepancy_um` is that of the model's own error that the covariance does not own up to.
    """

    model: Preisach
    factor_um: np.ndarray
    noise_um: float
    correlation: float
    discrepancy_um: float


@dataclass(frozen=True)
class GridSolution:
    """Non-negative weights and slopes of a grid, in strokes, and the Gaussian posterior they are the mode of."""

    columns: np.ndarray
    posterior: Posterior
    hyper: Hyper


def solve_grid(
    data: Data, stroke_um: float, start: Hyper | None, correlation: float = 1.0, known: Hyper | None = None
) -> GridSolution:
    """Find the most probable non-negative columns, smoothness and noise, all in strokes, from a `start` on, if any.

    One in so many samples as `correlation` is taken for an independent one. Where the smoothness is `known`, only the
    noise is found anew, on a grid of more levels than the evidence needs. A `FitError` if the regression does not
    converge.
    """
    moments = data.total.scaled(1 / correlation, stroke_um)
    rough = roughness(data.grid.levels)
    if data.grid.levels > EVIDENCE_LEVELS:
        basis = interpolation(EVIDENCE_LEVELS, data.grid.levels)
        few, even = moments.project(basis), roughness(EVIDENCE_LEVELS)
        hyper = known or maximise_evidence(few, even, start)
        posterior = Posterior.of(moments, rough, hyper)
        # What the coarse levels could not follow was noise to them.
        determined = effective(even, hyper, Posterior.of(few, even, hyper))
        renewed = renew_noise(moments, hyper, posterior, determined)
        if abs(float(renewed.log_variance - hyper.log_variance)) > 0.02:  # worth another factorisation
            hyper, posterior = renewed, Posterior.of(moments, rough, renewed)
    else:
        hyper = known or maximise_evidence(moments, rough, start)
        posterior = Posterior.of(moments, rough, hyper)
    return _bounded(posterior, hyper)


def _bounded(posterior: Posterior, hyper: Hyper) -> GridSolution:
    columns, found = non_negative(posterior)
    if not found:
        raise FitError(FitStatus.MAX_STEPS)
    return GridSolution(columns, posterior, hyper)


def solve_coloured(data: Data, stroke_um: float, correlation: float, white: Hyper, relaxation: float) -> GridSolution:
    """Find the columns where only one in so many samples as `correlation` is independent; errors of `solve_grid`.

    Curvature counts less by so many e-folds as `relaxation` says than the evidence has it that takes all samples for
    independent ones; `white` is what it found. The covariance is larger by the `correlation` than theirs.
    """
    moments, rough = data.total.scaled(1.0, stroke_um), roughness(data.grid.levels)
    hyper = white.relaxed(relaxation)
    posterior = Posterior.of(moments, rough, hyper)
    renewed = renew_noise(moments, hyper, posterior, effective(rough, hyper, posterior))
    # The columns stay what they are: curvature counts less by what the noise is greater.
    hyper = renewed.relaxed(float(np.log(correlation) + renewed.log_variance - hyper.log_variance))
    return _bounded(Posterior.of(moments.scaled(1 / correlation, 1.0), rough, hyper), hyper)


def relaxation_of(data: Data, stroke_um: float, white: Hyper) -> float:
    """By how many e-folds curvature counts less than the evidence has it, so that blocks are predicted best.

    The evidence takes what neighbouring samples share for the density's, or what a model cannot follow for noise:
    the blocks may want more smoothness than it found, or less.
    """
    rough, blocks = roughness(data.grid.levels), data.blocks
    if data.grid.levels > BELIEF_LEVELS:
        basis = interpolation(BELIEF_LEVELS, data.grid.levels)
        rough, blocks = roughness(BELIEF_LEVELS), tuple(block.project(basis) for block in blocks)
    whole = reduce(operator.add, blocks)

    def error(efolds: float) -> float:
        square, hyper = 0.0, white.relaxed(efolds)
        for block in blocks:
            columns, _ = non_negative(Posterior.of((whole - block).scaled(1.0, stroke_um), rough, hyper))
            one = block.scaled(1.0, stroke_um)
            square += float(one.energy_um2 - 2 * columns @ one.cross_um + columns @ one.gram @ columns)
        return square

    best, least = 0.0, error(0.0)
    for step in (2.0, -2.0):
        while abs(best + step) <= _FARTHEST and (square := error(best + step)) < 0.998 * least:
            best, least = best + step, square
        if best != 0.0:
            break
    return best


def non_negative(posterior: Posterior) -> tuple[np.ndarray, bool]:
    """Find the mode of the posterior among non-negative columns; and whether it was found.

    Few columns ever touch zero. Only the lowest are treated as bounded, the others follow them linearly; if one of
    those ends up below zero, more are bounded. The answer is that of all bounds together.
    """
    posterior = jax.tree.map(np.asarray, posterior)
    if np.all(posterior.mean >= 0):
        return np.asarray(posterior.mean), True
    scale = np.sqrt(np.diagonal(posterior.precision))
    lowest = posterior.mean * scale
    if not np.all(np.isfinite(lowest)):  # rounding left no Cholesky factor
        return np.zeros_like(posterior.mean), False
    if not np.all(np.isfinite(posterior.root)):
        return _one_by_one(posterior)
    size = len(lowest)
    bounded = 64
    while True:
        bounded = min(size, max(bounded, 2 ** int(np.ceil(np.log2(1 + 2 * np.sum(lowest < 0))))))
        order = np.sort(np.argsort(lowest, kind="stable")[:bounded])
        spread, precision, mean, unit = _marginal(posterior, order)
        if not np.all(np.isfinite(precision)):
            return _one_by_one(posterior)
        most_steps = _STEPS if bounded <= _SOON else _FEW_STEPS
        y, found = pivot_nonnegative(precision, -(precision @ mean), np.maximum(mean, 0), _ATOL, most_steps)
        if not found:
            return _one_by_one(posterior)
        # All columns move along with the chosen ones, from their mean; where a bound holds it holds exactly.
        columns = posterior.mean + spread @ (unit * (precision @ (y - mean)))
        columns[order] = y / unit
        left = columns * scale
        if bounded == size or np.all(left >= -_ATOL):
            return np.maximum(columns, 0), True
        lowest = np.minimum(lowest, left)
        bounded *= 2


def _one_by_one(posterior: Posterior) -> tuple[np.ndarray, bool]:
    """The same, slow and sure, where block pivoting goes round in circles or rounding leaves no Cholesky factor."""
    from scipy.optimize import nnls  # slow to import, and hardly ever needed

    precision = posterior.precision
    # More columns would take it minutes: a coarser grid must do.
    if len(precision) > _SOON:
        return np.maximum(posterior.mean, 0), False
    scale = np.sqrt(np.diagonal(precision))
    value, vector = np.linalg.eigh(precision / scale / scale[:, None])
    root = np.sqrt(np.maximum(value, 0.0))[:, None] * vector.T
    try:
        columns, _ = nnls(root, root @ (scale * posterior.mean), maxiter=30 * len(scale))
    except RuntimeError:
        return np.maximum(posterior.mean, 0), False
    return np.asarray(columns / scale), True


def _marginal(posterior: Posterior, which: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Covariance of all columns with the chosen ones, which ascend, and the posterior of those alone, scaled."""
    rows = np.zeros((len(posterior.mean), len(which)), order="F")
    rows[which, np.arange(len(which))] = 1.0
    half = scipy.linalg.solve_triangular(posterior.root, rows, lower=True, check_finite=False)
    spread = scipy.linalg.solve_triangular(posterior.root, half, lower=True, trans=1, check_finite=False)
    # Their covariance is `half.T @ half`: inverted as it is, rounding might leave it indefinite.
    root, failed = scipy.linalg.lapack.dtrtri(np.linalg.qr(half, mode="r"))
    precision = root @ root.T if not failed else np.full_like(root, np.nan)
    # Scaled so that every diagonal entry is 1: tolerances then mean standard deviations.
    scale = np.sqrt(np.diagonal(precision))
    return spread, precision / (scale[:, None] * scale[None, :]), posterior.mean[which] * scale, scale


def grid_estimate(
    data: Data, solution: GridSolution, stroke_um: float, correlation: float, discrepancy_um: float
) -> Estimate:
    """Turn a solution in strokes into an estimate in um; the last two arguments are those of `Estimate`."""
    factor, levels = solution.posterior.factor(), data.grid.levels
    if levels > BELIEF_LEVELS:
        basis = interpolation(BELIEF_LEVELS, levels)
        moments = data.total.scaled(1 / correlation, stroke_um).project(basis)
        factor = basis @ Posterior.of(moments, roughness(BELIEF_LEVELS), solution.hyper).factor()
    return Estimate(
        model=data.grid.model(solution.columns * stroke_um, np.zeros(())),
        factor_um=factor * stroke_um,
        noise_um=float(np.exp(solution.hyper.log_variance / 2)) * stroke_um,
        correlation=correlation,
        discrepancy_um=discrepancy_um,
    )


def cross_validate(
    data: Data, runs: Sequence[Run], stroke_um: float, correlation: float, hyper: Hyper, levels: int
) -> tuple[float, float]:
    """Predict each block of every run from the others, with the smoothness and noise given, on few levels.

    Returns the root mean square error in um, up to a constant in each block, and the model discrepancy in um: the
    part of the error that neighbouring samples share, which is no noise, beyond the posterior's own; zero if none.
    """
    rough, blocks, basis = roughness(data.grid.levels), data.blocks, None
    if levels < data.grid.levels:
        basis = interpolation(levels, data.grid.levels)
        rough, blocks = roughness(levels), tuple(block.project(basis) for block in blocks)
    whole = reduce(operator.add, blocks)
    numbers = [number for number, block in enumerate(blocks) if block.count > 0]
    found, expected = [], 0.0
    for number in numbers:
        posterior = Posterior.of((whole - blocks[number]).scaled(1 / correlation, stroke_um), rough, hyper)
        found.append(non_negative(posterior)[0])
        # The variances that the posterior gives its predictions of the block.
        expected += float(np.vdot(inverse(np.asarray(posterior.root)), blocks[number].gram)) * stroke_um**2
    columns = np.stack(found, axis=1) * stroke_um
    surface = data.grid.surface(columns if basis is None else basis @ columns)
    squares = shared = 0.0
    for run in runs:
        label = blocks_of(run, data.pieces)
        left_um = run.displacement_um - _predicted_um(
            surface, run, np.searchsorted(numbers, label).clip(max=len(numbers) - 1)
        )
        for number in numbers:
            # A short run may have no sample in a block.
            if (inside := label == number).any():
                left = run.without_nuisance(left_um, inside)
                off = run.weighed(left)[inside]
                squares += float(np.sum(off**2))
                shared += shared_square(off) * len(off)
    count = sum(float(blocks[number].count) for number in numbers)
    return (squares / count) ** 0.5, (max(0.0, shared - expected) / count) ** 0.5


def _predicted_um(surface: Surface, run: Run, which: np.ndarray) -> np.ndarray:
    """Predict each sample of a run by one of several surfaces, `(n,)`."""
    found, first = [], 0
    for piece in run.path:
        every = surface.respond(piece)
        found.append(np.take_along_axis(every, which[first : first + len(every), None], axis=1)[:, 0])
        first += len(every)
    return np.concatenate(found)
