"""How smooth and how noisy a density is believed to be: found by maximising the evidence, not set by hand."""

from functools import lru_cache
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from fits.loop._moments import Moments

# Logarithms of the weights where the data say nothing: a density, of some strokes per squared range, whose slope is
# ten, along the diagonal a third, and whose curvature is free, and a reversible slope whose curvature is ten.
_MIDDLING = (-12.0, np.log(1e-2), 2.0, np.log(1e-2))


class Hyper(eqx.Module):
    """How smooth and how noisy, as natural logarithms; found from the data by the evidence.

    `log_density` weighs the integrated squared curvature of the density in all directions, `log_slope` its squared
    slope, as a density may have kinks anywhere, of which curvature would be too sure, `log_along` its squared slope
    along the diagonal, as loops of one size are alike at all biases (exactly so in sums of plays), and
    `log_reversible` the squared curvature of the reversible slope. `log_variance` is of noise, in squared strokes.
    """

    log_density: Float[Array, ""]
    log_slope: Float[Array, ""]
    log_along: Float[Array, ""]
    log_reversible: Float[Array, ""]
    log_variance: Float[Array, ""]

    @classmethod
    def start(cls) -> "Hyper":
        """Weights that are believed beforehand, and noise of a thousandth of the stroke."""
        _, slope, along, reversible = map(jnp.asarray, _MIDDLING)
        # Curvature is found from where it counts.
        return cls(jnp.asarray(np.log(1e-2)), slope, along, reversible, jnp.asarray(np.log(1e-6)))

    def relaxed(self, efolds: float) -> "Hyper":
        """The same with all slopes and curvature counting less by so many e-folds."""
        weights = jax.tree.map(lambda weight: weight - efolds, self)
        return eqx.tree_at(lambda h: h.log_variance, weights, self.log_variance)


class Roughness(eqx.Module):
    """Quadratic forms that measure the squared slopes and curvature that `Hyper` weighs, in columns of a `Grid`."""

    density: Float[Array, "D D"]
    slope: Float[Array, "D D"]
    along: Float[Array, "D D"]
    reversible: Float[Array, "D D"]

    @eqx.filter_jit
    def precision(self, hyper: Hyper) -> Float[Array, "D D"]:
        """Prior precision of the columns in strokes, shape `(D, D)`; positive definite."""
        uneven = (
            jnp.exp(hyper.log_density) * self.density
            + jnp.exp(hyper.log_slope) * self.slope
            + jnp.exp(hyper.log_along) * self.along
            + jnp.exp(hyper.log_reversible) * self.reversible
        )
        # What is even costs nothing, but no density of 100 strokes is believed; and a great weight on the rest
        # must not make it negative by rounding.
        floor = 1 / 100.0**2 + 1e-14 * jnp.max(jnp.diagonal(uneven))
        return uneven + floor * jnp.eye(uneven.shape[0])

    def project(self, basis: Float[Array | np.ndarray, "D d"]) -> "Roughness":
        """Keep only combinations of columns."""
        return jax.tree.map(lambda form: jnp.asarray(basis.T @ form @ basis), self)


def roughness(levels: int) -> Roughness:
    """Build the forms for a grid of `levels`."""
    return Roughness(*(jnp.asarray(form) for form in _matrices(levels)))


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
    position = np.linspace(0, coarse - 1, fine)
    cell = np.minimum(position.astype(np.int64), coarse - 2)
    part = position - cell
    line = np.zeros((fine, coarse))
    line[np.arange(fine), cell] = 1 - part
    line[np.arange(fine), cell + 1] += part
    # Under the diagonal triangles the coarse grid goes on linearly: node (i, i + 1) = (i, i) + (i+1, i+1) - (i+1, i).
    m = coarse * (coarse + 1) // 2
    spread = np.zeros((coarse, coarse, m))
    spread[np.tril_indices(coarse)] = np.eye(m)
    k = np.arange(coarse - 1)
    spread[k, k + 1] = spread[k, k] + spread[k + 1, k + 1] - spread[k + 1, k]
    nodes = np.einsum("ai,bj,ijm->abm", line, line, spread, optimize=True)[np.tril_indices(fine)]
    out = np.zeros((nodes.shape[0] + fine, m + coarse))
    out[: nodes.shape[0], :m] = nodes
    out[nodes.shape[0] :, m:] = line
    return out


class Posterior(eqx.Module):
    """Gaussian posterior of the columns, in strokes, without bounds; `root` is the precision's Cholesky factor."""

    mean: Float[Array, " D"]
    precision: Float[Array, "D D"]
    root: Float[Array, "D D"]

    @classmethod
    @eqx.filter_jit
    def of(cls, moments: Moments, rough: Roughness, hyper: Hyper) -> "Posterior":
        """Condition the prior on the data."""
        variance = jnp.exp(hyper.log_variance)
        precision = jnp.asarray(moments.gram / variance + rough.precision(hyper))
        # What rounding leaves of what a past has taken off may be negative.
        precision += 1e-14 * jnp.max(jnp.diagonal(precision)) * jnp.eye(precision.shape[0])
        root = jnp.linalg.cholesky(precision)
        mean = jax.scipy.linalg.cho_solve((root, True), moments.cross_um / variance)
        return cls(mean, precision, root)

    @eqx.filter_jit
    def factor(self) -> Float[Array, "D D"]:
        """Factor of the covariance: `factor @ factor.T` is the inverse of the precision."""
        unit = jnp.eye(self.mean.shape[0])
        return jax.scipy.linalg.solve_triangular(self.root, unit, lower=True).T


def _negative_log(hyper: Hyper, args: tuple[Moments, Roughness]) -> Float[Array, ""]:
    """Negative logarithm of the evidence (MacKay 1992; Rasmussen & Williams 2006, ch. 2), but for a constant."""
    moments, rough = args
    prior = rough.precision(hyper)
    variance = jnp.exp(hyper.log_variance)
    root = jnp.linalg.cholesky(moments.gram / variance + prior)
    half = jax.scipy.linalg.solve_triangular(root, moments.cross_um / variance, lower=True)
    misfit = moments.energy_um2 / variance - half @ half
    volume = 2 * jnp.sum(jnp.log(jnp.diagonal(root)))
    prior_volume = 2 * jnp.sum(jnp.log(jnp.diagonal(jnp.linalg.cholesky(prior))))
    weights = jnp.stack([hyper.log_density, hyper.log_slope, hyper.log_along, hyper.log_reversible])
    # Where the evidence is flat the smoothness stays within some times six e-folds of a middling one.
    unlikely = jnp.sum(((weights - jnp.asarray(_MIDDLING)) / 6.0) ** 2)
    return jnp.asarray(moments.count * hyper.log_variance + misfit + volume - prior_volume + unlikely) / 2


@eqx.filter_jit
def maximise_evidence(moments: Moments, rough: Roughness, start: Hyper) -> Hyper:
    """Find the smoothness and the noise under which the data, in strokes, are most probable."""
    solver: Any = optx.BFGS(rtol=1e-3, atol=1e-2)
    solution: Any = optx.minimise(_negative_log, solver, start, args=(moments, rough), max_steps=256, throw=False)
    # Out of steps on a flat evidence, the best place so far is as good as any; the regression itself must converge.
    return solution.value


@eqx.filter_jit
def effective(rough: Roughness, hyper: Hyper, posterior: Posterior) -> Float[Array, ""]:
    """Count the columns that the data, not the prior, determine."""
    prior = jnp.linalg.cholesky(rough.precision(hyper))
    held = jax.scipy.linalg.solve_triangular(posterior.root, prior, lower=True)
    return prior.shape[0] - jnp.sum(held**2)


@eqx.filter_jit
def renew_noise(moments: Moments, hyper: Hyper, posterior: Posterior, determined: Float[Array, ""]) -> Hyper:
    """Re-estimate the noise from what is left at the full resolution (MacKay's fixed point)."""
    left = moments.energy_um2 - 2 * posterior.mean @ moments.cross_um + posterior.mean @ moments.gram @ posterior.mean
    variance = jnp.maximum(left, 0) / jnp.maximum(moments.count - determined, 1)
    return eqx.tree_at(lambda h: h.log_variance, hyper, jnp.log(jnp.maximum(variance, 1e-30)))
