"""Convex quadratics over non-negative variables: block principal pivoting, as an optimistix minimiser."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int, PyTree, Scalar
from optimistix import RESULTS

# Exchanges that may fail to reduce the number of violations before they are made one at a time.
_PATIENCE = 3


class _State(eqx.Module):
    hessian: Float[Array, "D D"]
    linear: Float[Array, " D"]
    free: Bool[Array, " D"]
    wrong: Bool[Array, " D"]
    fewest: Int[Array, ""]
    patience: Int[Array, ""]
    left: Float[Array, ""]
    aux: Any


class BlockPivoting(optx.AbstractMinimiser[Float[Array, " D"], Any, _State]):
    """Minimise a strictly convex quadratic subject to `y >= 0`, to the optimality conditions.

    Every step solves for the variables that are free, the others being zero, and exchanges all those of either kind
    that violate their condition; where that stops helping, one at a time, which must end (Judice & Pires, Comput.
    Oper. Res. 21, 1994; Kim & Park, SIAM J. Sci. Comput. 33, 2011). Variables that the data want to be zero become
    exactly zero. SciPy's `nnls` takes one at a time and runs neither compiled nor in batches. The Hessian is taken
    once, at the start, or from `options["hessian"]`; variables that start above zero start free. `atol` is the
    largest violation of the conditions; `rtol` and `norm`, part of every optimistix solver, are not used.
    """

    rtol: float
    atol: float
    norm: Callable[[PyTree], Scalar]

    def init(self, fn, y, args, options, f_struct, aux_struct, tags) -> _State:  # type: ignore[no-untyped-def]
        """Take the Hessian at the start, and the gradient at zero."""
        del f_struct, aux_struct, tags
        hessian = options["hessian"] if "hessian" in options else jax.hessian(lambda z: fn(z, args)[0])(y)
        linear, aux = jax.grad(lambda z: fn(z, args), has_aux=True)(jnp.zeros_like(y))
        nothing = jnp.zeros_like(y, dtype=bool)
        far = jnp.asarray(jnp.inf, dtype=y.dtype)
        return _State(hessian, linear, y > 0, nothing, jnp.asarray(y.size + 1), jnp.asarray(_PATIENCE), far, aux)

    def step(self, fn, y, args, options, state, tags):  # type: ignore[no-untyped-def]
        """Exchange what violated its condition, and solve for the variables that are free now."""
        del options, tags
        free = state.free ^ state.wrong
        reduced = jnp.where(free[:, None] & free[None, :], state.hessian, jnp.diag(jnp.diagonal(state.hessian)))
        y = jax.scipy.linalg.solve(reduced, jnp.where(free, -state.linear, 0), assume_a="pos")
        gradient = state.hessian @ y + state.linear
        violation = jnp.where(free, -y, -gradient)
        wrong = violation > self.atol
        count = jnp.sum(wrong)
        fewer = count < state.fewest
        patience = jnp.where(fewer, _PATIENCE, state.patience - 1)
        last = jnp.arange(y.size) == jnp.max(jnp.where(wrong, jnp.arange(y.size), -1))
        y = jnp.maximum(y, 0)
        return (
            y,
            _State(
                state.hessian,
                state.linear,
                free,
                jnp.where(patience >= 0, wrong, last),
                jnp.minimum(count, state.fewest),
                jnp.maximum(patience, -1),
                jnp.maximum(jnp.max(violation), 0),
                state.aux,
            ),
            state.aux,
        )

    def terminate(self, fn, y, args, options, state, tags) -> tuple[Bool[Array, ""], RESULTS]:  # type: ignore[no-untyped-def]
        """Stop once the optimality conditions hold."""
        del fn, args, options, tags
        # A comparison with NaN must end the search too.
        broken = jnp.any(~jnp.isfinite(y))
        return broken | (state.left <= self.atol), RESULTS.where(broken, RESULTS.nonfinite, RESULTS.successful)

    def postprocess(self, fn, y, aux, args, options, state, tags, result):  # type: ignore[no-untyped-def]
        """Report how far from optimal the end is."""
        del fn, args, options, tags, result
        return y, aux, {"violation": state.left}
