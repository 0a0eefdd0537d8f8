"""How smooth and how noisy: found by maximising the probability of the data (the evidence), not set by hand."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Float

from fits.loop._moments import Moments
from fits.loop._prior import Hyper, Roughness

# Where the evidence is flat the smoothness stays within a few times this factor, in e-folds, of a middling one.
_MIDDLE, _WIDTH = -4.6, 6.0


class Posterior(eqx.Module):
    """Gaussian posterior of the columns, in strokes, before non-negativity.

    `precision` is the inverse of the covariance, `root` its lower Cholesky factor.
    """

    mean: Float[Array, " D"]
    precision: Float[Array, "D D"]
    root: Float[Array, "D D"]

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
    weights = jnp.stack([hyper.log_density, hyper.log_along, hyper.log_reversible])
    unlikely = jnp.sum(((weights - _MIDDLE) / _WIDTH) ** 2)
    return jnp.asarray(moments.count * hyper.log_variance + misfit + volume - prior_volume + unlikely) / 2


@eqx.filter_jit
def maximise_evidence(moments: Moments, rough: Roughness, start: Hyper) -> Hyper:
    """Find the smoothness and the noise under which the data, in strokes, are most probable."""
    solver: Any = optx.BFGS(rtol=1e-3, atol=1e-2)
    solution: Any = optx.minimise(_negative_log, solver, start, args=(moments, rough), max_steps=256, throw=False)
    # Out of steps on a flat evidence, the best place so far is as good as any; the regression itself must converge.
    return solution.value


@eqx.filter_jit
def posterior_of(moments: Moments, rough: Roughness, hyper: Hyper) -> Posterior:
    """Condition the prior on the data."""
    prior = rough.precision(hyper)
    variance = jnp.exp(hyper.log_variance)
    precision = jnp.asarray(moments.gram / variance + prior)
    root = jnp.linalg.cholesky(precision)
    mean = jax.scipy.linalg.cho_solve((root, True), moments.cross_um / variance)
    return Posterior(mean, precision, root)


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
