"""How smooth and how noisy a density is believed to be: found by maximising the evidence, not set by hand.

The algebra is NumPy's and SciPy's where the moments are, so that one fit compiles nothing, and else JAX's.
"""

from dataclasses import replace
from functools import lru_cache
from itertools import pairwise
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Float

from fits.loop._moments import Moments, zero_dimensional
from fits.loop._result import FitError, FitStatus
from fits.loop._surface import continued, spread
from fits.stats._bfgs import minimise

# Logarithms of the weights where the data say nothing: a density, of some strokes per squared range, whose slope is
# ten, along the diagonal a third, and whose curvature is free, a reversible slope whose curvature is ten, and plays
# of a thousandth of the stroke.
_MIDDLING = (-12.0, np.log(1e-2), 2.0, np.log(1e-2), 14.0)
# How far, in e-folds, they are believed to be from there.
_WIDTH = 6.0
# Rounds in which the noise is found first; what rounding may take off a diagonal, relative to its largest entry.
_ROUNDS, _ROUNDING = 2, 1e-14
# Least eigenvalue of a scaled precision, over the largest, that rounding leaves.
_LEAST = 1e-12


class Hyper(eqx.Module):
    """How smooth and how noisy, as natural logarithms; found from the data by the evidence.

    `log_density` weighs the integrated squared curvature of the density in all directions, `log_slope` its squared
    slope, as a density may have kinks anywhere, of which curvature would be too sure, `log_along` its squared slope
    along the diagonal, as loops of one size are alike at all biases (exactly so in sums of plays), and
    `log_reversible` the squared curvature of the reversible slope. `log_variance` is of noise, in squared strokes.
    `log_plays` weighs the squares of what plays add to the density, if there are any (see `with_plays`).
    """

    log_density: Float[Array | np.ndarray, ""] = eqx.field(converter=zero_dimensional)
    log_slope: Float[Array | np.ndarray, ""] = eqx.field(converter=zero_dimensional)
    log_along: Float[Array | np.ndarray, ""] = eqx.field(converter=zero_dimensional)
    log_reversible: Float[Array | np.ndarray, ""] = eqx.field(converter=zero_dimensional)
    log_variance: Float[Array | np.ndarray, ""] = eqx.field(converter=zero_dimensional)
    log_plays: Float[Array | np.ndarray, ""] | None = eqx.field(converter=zero_dimensional, default=None)

    @classmethod
    def start(cls) -> "Hyper":
        """Weights that are believed beforehand, and noise of a thousandth of the stroke."""
        # Curvature is found from where it counts.
        return cls.of(np.log(1e-2), *_MIDDLING[1:4], np.log(1e-6))

    @classmethod
    def of(cls, *logs: Any) -> "Hyper":
        """From numbers of any kind, in the order of the fields."""
        return cls(*logs)

    def relaxed(self, efolds: float) -> "Hyper":
        """The same with all slopes and curvature counting less by so many e-folds."""
        return Hyper.of(*(weight - efolds for weight in self.weights[:4]), self.log_variance)

    @property
    def weights(self) -> list[Any]:
        """Logarithms of the weights of all kinds, in the order of `Roughness`."""
        plays = [] if self.log_plays is None else [self.log_plays]
        return [self.log_density, self.log_slope, self.log_along, self.log_reversible, *plays]


class Roughness(eqx.Module):
    """Quadratic forms that measure the squared slopes and curvature that `Hyper` weighs, in columns of a `Grid`."""

    density: Float[Array | np.ndarray, "D D"]
    slope: Float[Array | np.ndarray, "D D"]
    along: Float[Array | np.ndarray, "D D"]
    reversible: Float[Array | np.ndarray, "D D"]
    plays: Float[Array | np.ndarray, "D D"] | None = None

    def precision(self, hyper: Hyper) -> Float[Array | np.ndarray, "D D"]:
        """Prior precision of the columns in strokes, shape `(D, D)`; positive definite."""
        xp, _ = _algebra(self.density, hyper.log_density)
        forms = jax.tree.leaves(self)
        uneven = sum(xp.exp(weight) * form for weight, form in zip(hyper.weights, forms, strict=True))
        # What is even costs nothing, but no density of 100 strokes is believed; and a great weight on the rest
        # must not make it negative by rounding.
        floor = 1 / 100.0**2 + _ROUNDING * xp.max(xp.diagonal(uneven))
        return uneven + floor * xp.eye(uneven.shape[0])

    def project(self, basis: Float[Array | np.ndarray, "D d"]) -> "Roughness":
        """Keep only combinations of columns."""
        return jax.tree.map(lambda form: basis.T @ form @ basis, self)

    def with_plays(self, count: int) -> "Roughness":
        """The same beside so many plays behind the columns, which are as they are without each other."""
        padded = jax.tree.map(lambda form: np.pad(form, (0, count)), self)
        return replace(padded, plays=np.diag(np.repeat([0.0, 1.0], [len(self.density), count])))


def roughness(levels: int) -> Roughness:
    """Build the forms for a grid of `levels`."""
    return Roughness(*_matrices(levels))


def _algebra(*numbers: Any) -> tuple[Any, Any]:
    """Modules of arrays and of their linear algebra, for numbers that are NumPy's or, any of them, JAX's."""
    traced = any(isinstance(one, jax.Array) for one in numbers)
    return (jnp, jax.scipy.linalg) if traced else (np, scipy.linalg)


@lru_cache(maxsize=16)
def _matrices(n: int) -> np.ndarray:
    step, second = np.array([-1.0, 1.0]), np.array([1.0, -2.0, 1.0])
    # Along alpha, along beta, and the mixed derivative, which counts twice.
    density = (
        _squared(n, ((-1, 0), (0, 0), (1, 0)), second)
        + _squared(n, ((0, -1), (0, 0), (0, 1)), second)
        + _squared(n, ((0, 0), (1, 0), (0, 1), (1, 1)), np.sqrt(2.0) * np.array([1.0, -1.0, -1.0, 1.0]))
    )
    slope = _squared(n, ((0, 0), (1, 0)), step) + _squared(n, ((0, 0), (0, 1)), step)
    reversible = np.diff(np.eye(n), 2, axis=0)
    weights = len(density)
    forms = np.zeros((4, weights + n, weights + n))
    # Over a step of 1 / (n - 1) a second difference is a derivative times the step squared, a first one times it.
    forms[0, :weights, :weights] = density * (n - 1) ** 2
    forms[1, :weights, :weights] = slope
    forms[2, :weights, :weights] = _squared(n, ((0, 0), (1, 1)), step)
    forms[3, weights:, weights:] = reversible.T @ reversible * (n - 1) ** 3
    return forms


def _squared(n: int, offsets: tuple[tuple[int, int], ...], factors: np.ndarray) -> np.ndarray:
    """Sum of the squares of a stencil over its places in the half-plane, weighed by distance from the diagonal."""
    weights = n * (n + 1) // 2
    place = -np.ones((n, n), dtype=np.int64)
    place[np.tril_indices(n)] = np.arange(weights)
    i, j = np.tril_indices(n)
    nodes = np.array([(i + di, j + dj) for di, dj in offsets])
    inside = np.all((nodes >= 0) & (nodes < n), axis=(0, 1)) & np.all(nodes[:, 0] >= nodes[:, 1], axis=0)
    columns = place[nodes[:, 0][:, inside], nodes[:, 1][:, inside]]
    # Relays that switch close together are many, and their density changes fast: by distance in ranges.
    weight = (((i - j)[inside] / (n - 1) + 0.05) / 0.35) ** 2
    form = np.zeros((weights, weights))
    for one, left in zip(columns, factors, strict=True):
        for other, right in zip(columns, factors, strict=True):
            np.add.at(form, (one, other), left * right * weight)
    return form


@lru_cache(maxsize=16)
def interpolation(coarse: int, fine: int) -> np.ndarray:
    """Columns of a fine grid as read off a coarse one between its nodes, shape `(D_fine, D_coarse)`."""
    return reread(np.eye(coarse * (coarse + 3) // 2), coarse, fine)


def reread(columns: np.ndarray, coarse: int, fine: int) -> np.ndarray:
    """Read columns of a coarse grid, `(D_coarse, k)`, off between its nodes as those of a fine one, `(D_fine, k)`."""
    position = np.linspace(0, coarse - 1, fine)
    cell = np.minimum(position.astype(np.int64), coarse - 2)
    part = position - cell
    line = np.zeros((fine, coarse))
    line[np.arange(fine), cell] = 1 - part
    line[np.arange(fine), cell + 1] += part
    density, slope = np.split(columns, [coarse * (coarse + 1) // 2])
    nodes = np.einsum("ai,bj,ijm->abm", line, line, continued(spread(density, coarse)), optimize=True)
    return np.concatenate([nodes[np.tril_indices(fine)], line @ slope])


class Posterior(eqx.Module):
    """Gaussian posterior of the columns, in strokes, without bounds; `root` is the precision's Cholesky factor.

    Where rounding leaves no factor, mean and factor are NaN.
    """

    mean: Float[Array | np.ndarray, " D"]
    precision: Float[Array | np.ndarray, "D D"]
    root: Float[Array | np.ndarray, "D D"]

    @classmethod
    def of(cls, moments: Moments, rough: Roughness, hyper: Hyper) -> "Posterior":
        """Condition the prior on the data."""
        xp, linalg = _algebra(moments.gram, rough.density, hyper.log_variance)
        variance = xp.exp(hyper.log_variance)
        precision = moments.gram / variance + rough.precision(hyper)
        # What rounding leaves of what a past has taken off may be negative.
        precision = precision + _ROUNDING * xp.max(xp.diagonal(precision)) * xp.eye(precision.shape[0])
        root = cholesky(precision)
        mean = linalg.cho_solve((root, True), moments.cross_um / variance, **_unchecked(xp))
        return cls(mean, precision, root)

    def factor(self) -> np.ndarray:
        """Factor of the covariance: `factor @ factor.T` is the inverse of the precision."""
        return np.asarray(scipy.linalg.solve_triangular(self.root, np.eye(len(self.mean)), lower=True).T)


def cholesky(matrix: Any) -> Any:
    """Lower Cholesky factor; NaN where there is none."""
    xp, _ = _algebra(matrix)
    try:
        return xp.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        return np.full_like(matrix, np.nan)


def definite(precision: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A precision and its Cholesky factor, `(n, n)`, with the least eigenvalues raised where rounding left no factor.

    A `FitError` where it is none: nothing in it, or numbers that are not finite.
    """
    root = cholesky(precision)
    floor = _LEAST
    while not np.all(np.isfinite(root)):
        scale = np.sqrt(np.maximum(np.diagonal(precision), 1e-300))
        scaled = precision / scale / scale[:, None]
        value, vector = np.linalg.eigh(scaled) if np.all(np.isfinite(scaled)) else (np.zeros(1), scaled)
        if not value[-1] > 0:
            raise FitError(FitStatus.NONFINITE)
        half = (scale[:, None] * vector) * np.sqrt(np.maximum(value, floor * value[-1]))
        precision = half @ half.T
        root, floor = cholesky(precision), 10 * floor
    return precision, root


def _unchecked(xp: Any) -> dict[str, Any]:
    """Let SciPy pass NaN on, as JAX does."""
    return {"check_finite": False} if xp is np else {}


class Evidence:
    """Negative logarithm of the evidence of moments, but for a constant (MacKay 1992; Rasmussen & Williams 2006).

    Values and slopes are those at the logarithms of `Hyper`, in its order, shape `(5,)`, or `(6,)` with plays. Both
    are not numbers where a matrix has no Cholesky factor.
    """

    def __init__(self, moments: Moments, rough: Roughness):
        self._moments = jax.tree.map(np.asarray, moments)
        self._size = len(self._moments.cross_um)
        forms = [np.asarray(form) for form in jax.tree.leaves(rough)]
        self._forms = np.stack([form.ravel() for form in forms])
        self._diagonals = np.stack([np.diagonal(form) for form in forms])
        # Stretches of columns that no form couples with others, but for plays, none of which it couples.
        coupled = np.any(self._forms, axis=0).reshape(self._size, self._size)
        last = np.maximum.accumulate([np.flatnonzero(row).max(initial=k) for k, row in enumerate(coupled)])
        ends = np.flatnonzero(last == np.arange(self._size)) + 1
        ends = ends[np.diff(ends, prepend=0) > 1]
        self._parts = [slice(*ends) for ends in pairwise([0, *ends[ends < self._size], self._size])]

    def value(self, logs: np.ndarray) -> float:
        """The value alone."""
        return self._value(logs, *self._roots(logs))

    def of(self, hyper: Hyper) -> float:
        """The evidence itself."""
        return -self.value(np.array([float(log) for log in jax.tree.leaves(hyper)]))

    def slope(self, logs: np.ndarray) -> np.ndarray:
        """The derivatives alone, of the same shape."""
        return self._slope(logs, *self._roots(logs))

    def both(self, logs: np.ndarray) -> tuple[float, np.ndarray]:
        """Value and derivatives, which share what takes long."""
        roots = self._roots(logs)
        return self._value(logs, *roots), self._slope(logs, *roots)

    def _roots(self, logs: np.ndarray) -> tuple[np.ndarray, list[np.ndarray]]:
        """Cholesky factors of the precision, and of parts of the prior's, see `Roughness.precision`; lower ones."""
        weights = np.exp(np.delete(logs, 4))
        prior = (weights @ self._forms).reshape(self._size, self._size)
        prior[np.diag_indices(self._size)] += 1 / 100.0**2 + _ROUNDING * np.max(weights @ self._diagonals)
        parts = [cholesky(prior[part, part]) for part in self._parts]
        return cholesky(self._moments.gram / np.exp(logs[4]) + prior), parts

    def _value(self, logs: np.ndarray, root: np.ndarray, prior_roots: list[np.ndarray]) -> float:
        moments, variance = self._moments, np.exp(logs[4])
        half = scipy.linalg.solve_triangular(root, moments.cross_um / variance, lower=True, check_finite=False)
        misfit = moments.energy_um2 / variance - half @ half
        volume, *parts = (2 * np.sum(np.log(np.diagonal(one))) for one in (root, *prior_roots))
        # Where the evidence is flat the smoothness stays within some times six e-folds of a middling one.
        unlikely = np.sum(_off_middling(logs) ** 2)
        return float(moments.count * logs[4] + misfit + volume - sum(parts) + unlikely) / 2

    def _slope(self, logs: np.ndarray, root: np.ndarray, prior_roots: list[np.ndarray]) -> np.ndarray:
        moments, variance, weights = self._moments, np.exp(logs[4]), np.exp(np.delete(logs, 4))
        covariance = inverse(root)
        mean = covariance @ moments.cross_um / variance
        square = covariance + np.outer(mean, mean)
        for part, prior_root in zip(self._parts, prior_roots, strict=True):
            square[part, part] -= inverse(prior_root)
        # The floor of the precision follows its largest diagonal entry.
        floor = _ROUNDING * self._diagonals[:, np.argmax(weights @ self._diagonals)]
        out = 2 * _off_middling(logs) / _WIDTH + weights * (self._forms @ square.ravel() + floor * np.trace(square))
        left = moments.energy_um2 - 2 * mean @ moments.cross_um + mean @ moments.gram @ mean
        of_noise = moments.count - (left + np.vdot(covariance, moments.gram)) / variance
        return np.insert(out, 4, of_noise) / 2


def _off_middling(logs: np.ndarray) -> np.ndarray:
    """How far weights are from what is believed beforehand, in its widths."""
    weights = np.delete(logs, 4)
    return np.asarray((weights - _MIDDLING[: len(weights)]) / _WIDTH)


def inverse(root: np.ndarray) -> np.ndarray:
    """Inverse of a matrix by its lower Cholesky factor."""
    # LAPACK counts along columns: its upper factor is the lower one transposed, and it fills in one triangle.
    half, failed = scipy.linalg.lapack.dpotri(root.T, lower=0)
    if failed:
        return np.full_like(root, np.nan)
    full = half + half.T
    full[np.diag_indices(len(full))] /= 2
    return np.asarray(full)


def maximise_evidence(moments: Moments, rough: Roughness, start: Hyper | None) -> Hyper:
    """Find the smoothness and the noise under which the data, in strokes, are most probable, from a start if any."""
    evidence, cold = Evidence(moments, rough), start is None
    start, fresh = start or Hyper.start(), Hyper.start().log_density
    # Where curvature counts for nothing, or for all, the evidence is flat along it, and no way leads back.
    start = replace(start, log_density=fresh) if abs(float(start.log_density - fresh)) > _WIDTH else start
    # Far from the noise that there is the evidence is so steep that the search leaps over what it looks for.
    for _ in range(_ROUNDS):
        posterior = Posterior.of(moments, rough, start)
        found = renew_noise(moments, start, posterior, effective(rough, start, posterior))
        start = found if np.isfinite(found.log_variance) else start
    first = np.array([float(log) for log in jax.tree.leaves(start)])
    # A step too far is not finite, and taken back. Out of steps the best place so far is as good as any.
    with np.errstate(all="ignore"):
        return Hyper.of(*minimise(evidence.both, first, 1e-3, 1e-2, most_steps=128, cold=cold))


def effective(rough: Roughness, hyper: Hyper, posterior: Posterior) -> Float[Array | np.ndarray, ""]:
    """Count the columns that the data, not the prior, determine."""
    prior = cholesky(rough.precision(hyper))
    xp, linalg = _algebra(prior, posterior.root)
    held = linalg.solve_triangular(posterior.root, prior, lower=True, **_unchecked(xp))
    return zero_dimensional(prior.shape[0] - xp.sum(held**2))


def renew_noise(
    moments: Moments, hyper: Hyper, posterior: Posterior, determined: Float[Array | np.ndarray, ""]
) -> Hyper:
    """Re-estimate the noise from what is left at the full resolution (MacKay's fixed point)."""
    xp, _ = _algebra(moments.gram, posterior.mean)
    left = moments.energy_um2 - 2 * posterior.mean @ moments.cross_um + posterior.mean @ moments.gram @ posterior.mean
    variance = xp.maximum(left, 0) / xp.maximum(moments.count - determined, 1)
    return replace(hyper, log_variance=xp.log(xp.maximum(variance, 1e-30)))
