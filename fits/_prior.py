"""What is believed of a density before any data: that it is smooth, how much so being left to the data."""

from functools import lru_cache

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

# Standard deviation, in strokes, beyond which no density is believed even where the smoothness does not bind.
_WIDE = 100.0


class Hyper(eqx.Module):
    """How smooth and how noisy, as natural logarithms; found from the data by the evidence.

    Attributes
    ----------
    log_density
        Of the weight on the integrated squared curvature of the density.
    log_reversible
        Of the weight on the integrated squared curvature of the reversible slope.
    log_variance
        Of the noise variance, in squared strokes.
    """

    log_density: Float[Array, ""]
    log_reversible: Float[Array, ""]
    log_variance: Float[Array, ""]

    @classmethod
    def start(cls) -> "Hyper":
        """Curvatures of about ten strokes per squared range, noise of a thousandth of the stroke."""
        return cls(jnp.asarray(np.log(1e-2)), jnp.asarray(np.log(1e-2)), jnp.asarray(np.log(1e-6)))


class Roughness(eqx.Module):
    """Quadratic forms that measure curvature, in the columns of a `Grid`.

    Attributes
    ----------
    density
        Integral over the half-plane of the squared second derivatives of the density, shape `(D, D)`.
    reversible
        Integral of the squared second derivative of the reversible slope, shape `(D, D)`.
    """

    density: Float[Array, "D D"]
    reversible: Float[Array, "D D"]

    def precision(self, hyper: Hyper) -> Float[Array, "D D"]:
        """Prior precision of the columns in strokes, shape `(D, D)`; positive definite."""
        wide = jnp.eye(self.density.shape[0]) / _WIDE**2
        return jnp.exp(hyper.log_density) * self.density + jnp.exp(hyper.log_reversible) * self.reversible + wide

    def project(self, basis: Float[Array, "D d"]) -> "Roughness":
        """Keep only combinations of columns."""
        return Roughness(basis.T @ self.density @ basis, basis.T @ self.reversible @ basis)


def roughness(levels: int) -> Roughness:
    """Build the two forms for a grid of `levels`."""
    density, reversible = _matrices(levels)
    return Roughness(jnp.asarray(density), jnp.asarray(reversible))


@lru_cache(maxsize=16)
def _matrices(n: int) -> tuple[np.ndarray, np.ndarray]:
    weights = n * (n + 1) // 2
    place = -np.ones((n, n), dtype=np.int64)
    place[np.tril_indices(n)] = np.arange(weights)
    i, j = np.tril_indices(n)
    stencils = [
        # Along alpha, along beta, and the mixed derivative, which counts twice.
        (((-1, 0), (0, 0), (1, 0)), (1.0, -2.0, 1.0)),
        (((0, -1), (0, 0), (0, 1)), (1.0, -2.0, 1.0)),
        (((0, 0), (1, 0), (0, 1), (1, 1)), np.sqrt(2.0) * np.array([1.0, -1.0, -1.0, 1.0])),
    ]
    density = np.zeros((weights, weights))
    for offsets, factors in stencils:
        rows = np.array([(i + di, j + dj) for di, dj in offsets])
        inside = np.all((rows >= 0) & (rows < n), axis=(0, 1)) & np.all(rows[:, 0] >= rows[:, 1], axis=0)
        nodes = place[rows[:, 0][:, inside], rows[:, 1][:, inside]]
        for one, left in zip(nodes, factors, strict=True):
            for other, right in zip(nodes, factors, strict=True):
                np.add.at(density, (one, other), left * right)
    # A second difference over a step of 1 / (n - 1) is a derivative times the step squared.
    density *= (n - 1) ** 2
    second = np.diff(np.eye(n), 2, axis=0)
    size = weights + n
    full, line = np.zeros((size, size)), np.zeros((size, size))
    full[:weights, :weights] = density
    line[weights:, weights:] = second.T @ second * (n - 1) ** 3
    return full, line


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
