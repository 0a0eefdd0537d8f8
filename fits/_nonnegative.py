"""Convex quadratics over non-negative variables: projected Newton, as an optimistix minimiser."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float, PyTree, Scalar
from optimistix import RESULTS


class _State(eqx.Module):
    hessian: Float[Array, "D D"]
    gradient: Float[Array, " D"]
    value: Float[Array, ""]
    left: Float[Array, ""]
    aux: Any


class NonNegativeNewton(optx.AbstractMinimiser[Float[Array, " D"], Any, _State]):
    """Minimise a strictly convex quadratic subject to `y >= 0`, to the optimality conditions.

    Newton steps on the variables that are not held at their bound, bent along the boundary, with an Armijo search
    (Bertsekas, SIAM J. Control Optim. 20, 1982). Weights that the data want to be zero become exactly zero, which
    a bijection would only approach. The function must be quadratic: its Hessian is taken once, at the start, or from
    `options["hessian"]`.

    Attributes
    ----------
    atol
        Largest violation of the optimality conditions, in units of the variables.
    """

    atol: float
    rtol: float = 0.0
    norm: Callable[[PyTree], Scalar] = optx.max_norm

    def init(self, fn, y, args, options, f_struct, aux_struct, tags) -> _State:  # type: ignore[no-untyped-def]
        """Take the Hessian at the start."""
        del f_struct, aux_struct, tags
        hessian = options["hessian"] if "hessian" in options else jax.hessian(lambda z: fn(z, args)[0])(y)
        value, gradient, aux = _evaluate(fn, y, args)
        return _State(hessian, gradient, value, _violation(y, gradient, hessian), aux)

    def step(self, fn, y, args, options, state, tags):  # type: ignore[no-untyped-def]
        """Move the free variables to their minimum, or as far as the bounds let them."""
        del options, tags
        # Variables at the bound that would leave it stay there; those a step would overshoot bend along it.
        held = (y <= _edge(y, state)) & (state.gradient > 0)
        free = ~held
        reduced = jnp.where(free[:, None] & free[None, :], state.hessian, jnp.diag(jnp.diagonal(state.hessian)))
        slope = jnp.where(free, state.gradient, 0)
        direction = -jax.scipy.linalg.solve(reduced, slope, assume_a="pos")
        direction = jnp.where(free, direction, 0)
        lengths = 0.5 ** jnp.arange(20, dtype=y.dtype)
        trials = jnp.maximum(y[None, :] + lengths[:, None] * direction[None, :], 0)
        trials = jnp.where(held[None, :], 0, trials)
        values = jax.vmap(lambda z: fn(z, args)[0])(trials)
        best = jnp.argmin(values)
        y = jnp.where(values[best] < state.value, trials[best], y)
        value, gradient, aux = _evaluate(fn, y, args)
        return y, _State(state.hessian, gradient, value, _violation(y, gradient, state.hessian), aux), aux

    def terminate(self, fn, y, args, options, state, tags) -> tuple[Bool[Array, ""], RESULTS]:  # type: ignore[no-untyped-def]
        """Stop once the optimality conditions hold."""
        del fn, args, options, tags
        return state.left <= self.atol, RESULTS.where(
            jnp.isfinite(state.value), RESULTS.successful, RESULTS.nonfinite
        )

    def postprocess(self, fn, y, aux, args, options, state, tags, result):  # type: ignore[no-untyped-def]
        """Report how far from optimal the end is."""
        del fn, args, options, tags, result
        return y, aux, {"violation": state.left}


def _evaluate(fn: Callable[..., Any], y: Array, args: Any) -> tuple[Array, Array, Any]:
    (value, aux), gradient = jax.value_and_grad(lambda z: fn(z, args), has_aux=True)(y)
    return value, gradient, aux


def _edge(y: Array, state: _State) -> Array:
    return jnp.minimum(state.left, 1e-6)


def _violation(y: Array, gradient: Array, hessian: Array) -> Float[Array, ""]:
    """Length of the step that would remain, each variable taken by itself."""
    return jnp.max(jnp.abs(y - jnp.maximum(y - gradient / jnp.diagonal(hessian), 0)))
