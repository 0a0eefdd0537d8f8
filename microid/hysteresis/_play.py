"""Plays: a pointer dragged along by the input, with slack on either side."""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from microid._platform import _by_platform


def _plays(
    signal: Float[Array, " t"], slack: Float[Array, " k"], start: Float[Array, " k"] | None = None
) -> Float[Array, "t k"]:
    """Positions of plays along an input, shape `(t, k)`, exact for any path between the samples that is monotone.

    Parameters
    ----------
    signal
        The input, shape `(t,)`.
    slack
        Half the clearance of each play, shape `(k,)`, not negative.
    start
        Positions before the first sample, shape `(k,)`; all zero by default.

    Notes
    -----
    A play stands where the input, or its start, last pushed it: the derivative is that of the pushing sample.
    """
    start = jnp.zeros_like(slack) if start is None else start
    low, high = signal[:, None] - slack[None], signal[:, None] + slack[None]
    fixed = lax.stop_gradient((low, high, start))
    position = _by_platform(*fixed, cpu=_one_by_one, default=_all_at_once)
    before = jnp.concatenate([fixed[2][None], position[:-1]])
    rising, falling = fixed[0] >= before, fixed[1] <= before
    index = jnp.arange(1, signal.shape[0] + 1, dtype=jnp.int32)[:, None]
    last = lax.cummax(jnp.where(rising | falling, index, 0))
    pushed = jnp.where(rising, low, high)
    return jnp.take_along_axis(jnp.concatenate([start[None], pushed]), last, axis=0)


def _one_by_one(
    low: Float[Array, "t k"], high: Float[Array, "t k"], start: Float[Array, " k"]
) -> Float[Array, "t k"]:
    def visit(before: Array, now: tuple[Array, Array]) -> tuple[Array, Array]:
        after = jnp.clip(before, *now)
        return after, after

    return lax.scan(visit, start, (low, high))[1]


def _all_at_once(
    low: Float[Array, "t k"], high: Float[Array, "t k"], start: Float[Array, " k"]
) -> Float[Array, "t k"]:
    def join(early: tuple[Array, Array], late: tuple[Array, Array]) -> tuple[Array, Array]:
        return jnp.clip(early[0], *late), jnp.clip(early[1], *late)

    return jnp.clip(start[None], *lax.associative_scan(join, (low, high)))
