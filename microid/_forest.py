"""Sums along the branches of a hysteresis: every sample adds to the output of the one its branch hangs from."""

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from microid._platform import _by_platform


def forest_sum(step: Float[Array, " m *more"], anchor: Int[Array, " m"]) -> Float[Array, " m *more"]:
    """Solve `total[t] = step[t] + total[anchor[t]]`, with `total[0] = step[0]` at the root.

    Parameters
    ----------
    step
        What each entry adds, shape `(m, ...)`.
    anchor
        The entry it adds to; smaller than its own index, except that the root's is ignored.

    Returns
    -------
    Array
        The totals, shape `(m, ...)`. Linear in `step`, in forward and reverse mode.

    Notes
    -----
    One pass on a CPU; elsewhere pointer jumping, which takes the logarithm of the nesting depth.
    """

    def residual(total: Array) -> Array:
        return total - total[anchor].at[0].set(0)

    def solve(_: object, rhs: Array) -> Array:
        return _by_platform(anchor, rhs, cpu=_down, default=_down_by_jumping)

    def transpose_solve(_: object, rhs: Array) -> Array:
        return _by_platform(anchor, rhs, cpu=_up, default=_up_by_jumping)

    # The implicit form has a cheap transpose; differentiating the loops themselves would store every pass.
    return lax.custom_linear_solve(residual, step, solve, transpose_solve)


def _down(anchor: Int[Array, " m"], total: Float[Array, " m *more"]) -> Float[Array, " m *more"]:
    def visit(t: Int[Array, ""], total: Array) -> Array:
        return total.at[t].add(total[anchor[t]])

    return lax.fori_loop(np.int32(1), np.int32(anchor.shape[0]), visit, total)


def _up(anchor: Int[Array, " m"], total: Float[Array, " m *more"]) -> Float[Array, " m *more"]:
    last = np.int32(anchor.shape[0])

    def visit(s: Int[Array, ""], total: Array) -> Array:
        t = last - s
        return total.at[anchor[t]].add(total[t])

    return lax.fori_loop(np.int32(1), last, visit, total)


def _jump(anchor: Array, total: Array, add: object) -> Array:
    m = anchor.shape[0]
    # Entry m is a ground that absorbs what has passed the root.
    link = jnp.concatenate([anchor.at[0].set(m), jnp.array([m], dtype=anchor.dtype)])
    grounded = jnp.concatenate([total, jnp.zeros((1, *total.shape[1:]), total.dtype)])

    def more(carry: tuple[Array, Array]) -> Array:
        return jnp.any(carry[0] != m)

    def double(carry: tuple[Array, Array]) -> tuple[Array, Array]:
        link, total = carry
        return link[link], add(link, total).at[m].set(0)  # type: ignore[operator]

    return lax.while_loop(more, double, (link, grounded))[1][:m]


def _down_by_jumping(anchor: Int[Array, " m"], total: Float[Array, " m *more"]) -> Float[Array, " m *more"]:
    return _jump(anchor, total, lambda link, x: x + x[link])


def _up_by_jumping(anchor: Int[Array, " m"], total: Float[Array, " m *more"]) -> Float[Array, " m *more"]:
    return _jump(anchor, total, lambda link, x: x.at[link].add(x))
