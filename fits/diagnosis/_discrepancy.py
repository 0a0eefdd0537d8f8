"""What neither a baseline nor any effect explains: roughness of the density beyond its grid, and discrepancy."""

from collections.abc import Sequence
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
from scipy.linalg import qr, solve_triangular
from scipy.optimize import minimize

from fits.diagnosis._orthonormal import orthonormal, take_off
from fits.diagnosis._projector import Projector
from fits.diagnosis._regression import root_of
from fits.loop._grid import EVIDENCE_LEVELS
from fits.loop._moments import Moments
from fits.loop._prior import Hyper, interpolation, maximise_evidence, roughness
from fits.stage._information import prior_precision
from fits.stats._noise import Noise, learn_noise

# A density no rougher than this, relative to itself: beyond, it would follow effects.
ROUGHEST = 0.5
# Logarithms of the roughness that the search begins at, and of none.
_SOME, _NONE = -2.0, -30.0
_SEARCH = {"xatol": 0.05, "fatol": 0.05, "maxiter": 120}


def along_all(projector: Projector, candidates: Sequence[Sequence[np.ndarray]]) -> np.ndarray:
    """Orthonormal columns, off the tangent, that span what candidates change in each run, shape `(rows, k)`."""
    joined = np.empty((len(projector.residual), len(candidates)), order="F")
    for k, candidate in enumerate(candidates):
        joined[:, k] = projector.join(candidate)
    projector.take_off(joined)
    return orthonormal(joined)


def learn_roughness(
    projector: Projector, candidates: Sequence[Sequence[np.ndarray]], change_um: Sequence[np.ndarray] | None = None
) -> tuple[float, ...]:
    """Find how rough the density is beyond its grid, from what neither the baseline nor any candidate explains.

    Maximises the evidence over the standard deviations of the relative roughness of all kinds; a kind without which
    the residual is as probable is left out. What known effects change in each run, `change_um` of shape `(n,)`, is
    taken off before.
    """
    finer = projector.regression.finer
    sizes = [kind[0].shape[1] for kind in finer]
    residual = projector.residual if change_um is None else projector.residual - projector.join(change_um)
    off = np.empty((len(residual), sum(sizes) + 1), order="F")
    off[:, -1] = residual
    for kind, stop in zip(finer, np.cumsum(sizes), strict=True):
        off[:, stop - kind[0].shape[1] : stop] = projector.join(kind)
    projector.take_off(off)
    fixed = along_all(projector, candidates)
    take_off(off, fixed)
    columns, left = off[:, :-1], off[:, -1]
    gram, cross, energy = columns.T @ columns, columns.T @ left, float(left @ left)
    count = projector.count - projector.freedom - len(candidates)

    def unlikely(logs: np.ndarray) -> float:
        scale = np.repeat(np.exp(np.minimum(logs, np.log(ROUGHEST))), sizes)
        inner = np.eye(len(scale)) + scale[:, None] * gram * scale[None, :]
        root = np.linalg.cholesky(inner)
        half = solve_triangular(root, scale * cross, lower=True)
        # The noise may be a little more or less than what was taken off.
        return float(count * np.log(max(energy - half @ half, 1e-300)) + 2 * np.sum(np.log(np.diagonal(root)))) / 2

    at = np.full(len(sizes), _NONE)
    best = unlikely(at)
    # All kinds together, and each alone.
    for start in (np.full(len(sizes), _SOME), *(np.where(one, _SOME, _NONE) for one in np.eye(len(sizes)))):
        found = minimize(unlikely, start, method="Nelder-Mead", options=_SEARCH)
        if found.fun < best - 0.5:
            best, at = float(found.fun), found.x
    return tuple(float(min(np.exp(a), ROUGHEST)) if a > -12 else 0.0 for a in at)


def with_discrepancy(
    projector: Projector, candidates: Sequence[Sequence[np.ndarray]], change_um: Sequence[np.ndarray] | None = None
) -> tuple[Noise, ...]:
    """Noise of each run together with model discrepancy: what neither the baseline nor any candidate explains.

    That is an autoregression, no quieter than the noise of the projector; for `change_um` see `learn_roughness`.
    """
    residual = projector.residual if change_um is None else projector.residual - projector.join(change_um)
    fixed = along_all(projector, candidates)
    left = projector.off(residual)
    left -= fixed @ (fixed.T @ left)
    taken = projector.leverage + np.sum(fixed**2, axis=1)
    found = []
    for noise, part, freedom in zip(projector.noise, projector.split(left), projector.split(taken), strict=True):
        more = learn_noise(part, float(np.sum(freedom)))
        found.append(noise.followed_by(more) if noise.spread is None and more.total_um > 1 else noise)
    return tuple(found)


def smoothed(projector: Projector, change_um: Sequence[np.ndarray]) -> Projector:
    """The same beside the most probable density under what causes change in each run, shape `(n,)`.

    Maximises the evidence for the columns as `solve_grid` does, from the noise as it was found, with coordinates and
    nuisance parameters free (MacKay, Neural Computation 4 (1992) 415).
    """
    regression = projector.regression
    baseline, count = regression.baseline, projector.count
    size, stroke_um = len(baseline.columns_um), baseline.stroke_um
    joined = projector.join(regression.rows)[:count]
    columns = joined[:, :size]
    target = (projector.residual - projector.join(change_um))[:count] + columns @ baseline.columns_um
    others = np.concatenate([joined[:, size:], projector.nuisance_rows[:count]], axis=1)
    scale = np.linalg.norm(others, axis=0)
    basis, _ = qr(others[:, scale > 0] / scale[scale > 0], mode="economic")
    columns *= stroke_um
    take_off(columns, basis)
    target -= basis @ (basis.T @ target)
    left = np.asarray(float(count - basis.shape[1]))
    moments = Moments(columns.T @ columns, columns.T @ target, np.asarray(target @ target), left)
    rough, levels = roughness(baseline.chain.levels), baseline.chain.levels
    if levels > EVIDENCE_LEVELS:
        fewer = interpolation(EVIDENCE_LEVELS, levels)
        moments, rough = moments.project(fewer), rough.project(fewer)
    start = replace(Hyper.start(), log_variance=jnp.zeros(()))
    prior = prior_precision(baseline.chain, maximise_evidence(moments, rough, start), stroke_um)
    moved = replace(regression, baseline=replace(baseline, prior=prior), root=root_of(prior))
    return Projector(moved, projector.noise, projector.roughness, projector.held)
