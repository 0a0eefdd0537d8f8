"""Pieces of laws whose state follows the input at a rate per volt."""

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from microid._linear import recur

_TERMS = 16


def _direction(signal: Float[Array, " t"]) -> Float[Array, " t"]:
    """Sign of the move to each sample; of the last move where it stays, and up before any. No derivative."""
    sign = jnp.sign(jnp.diff(lax.stop_gradient(signal), prepend=signal[:1]))
    index = jnp.where(sign != 0, jnp.arange(signal.shape[0], dtype=jnp.int32), 0)
    return jnp.where(sign[lax.cummax(index)] < 0, -1, 1).astype(signal.dtype)


def _relax(keep: Float[Array, " t"], push: Float[Array, " t"], start: Float[Array, ""]) -> Float[Array, " t"]:
    """Solve `z[t] = keep[t] z[t - 1] + push[t]`, with `start` before the first."""
    return recur(keep[:, None, None], push.at[0].add(keep[0] * start)[:, None])[:, 0]


def _mean_decay(x: Float[Array, "..."]) -> Float[Array, "..."]:
    """`(1 - exp(-x)) / x` for `x >= 0`, with all its derivatives at zero."""
    return _series(x, 1, lambda x: -jnp.expm1(-x) / x)


def _mean_ramp(x: Float[Array, "..."]) -> Float[Array, "..."]:
    """`(x - 1 + exp(-x)) / x**2` for `x >= 0`, with all its derivatives at zero."""
    return _series(x, 2, lambda x: (x + jnp.expm1(-x)) / (x * x))


def _series(x: Array, order: int, direct: object) -> Array:
    """Sum of `(-x)**j / (j + order)!` near zero, where the direct form cancels."""
    small = x < 1
    near, far = jnp.where(small, x, 0), jnp.where(small, 1, x)
    total = jnp.ones_like(x)
    for j in range(_TERMS, 0, -1):
        total = 1 - near * total / (j + order)
    return jnp.where(small, total / float(np.prod(np.arange(1, order + 1))), direct(far))  # type: ignore[operator]
