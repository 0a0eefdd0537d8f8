"""Convex quadratics over non-negative variables: block principal pivoting."""

import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jax import lax
from jaxtyping import Array, Bool, Float

# Exchanges that may fail to reduce the number of violations before they are made one at a time.
_PATIENCE = 3


def minimise_nonnegative(
    hessian: Float[Array, "D D"], linear: Float[Array, " D"], start: Float[Array, " D"], atol: float, most_steps: int
) -> tuple[Float[Array, " D"], Bool[Array, ""]]:
    """Minimise the convex `y @ hessian @ y / 2 + linear @ y` subject to `y >= 0`; and say whether that succeeded.

    Every step solves for the variables that are free, the others being zero, and exchanges all those of either kind
    that violate their optimality condition by more than `atol`; where that stops helping, one at a time, which must
    end (Judice & Pires, Comput. Oper. Res. 21, 1994; Kim & Park, SIAM J. Sci. Comput. 33, 2011). Variables that the
    data want to be zero become exactly zero. SciPy's `nnls` takes one at a time and runs neither compiled nor in
    batches. Variables that start above zero start free. The values are NaN where the Hessian has no Cholesky factor.
    """

    # Minimiser, free variables, those to exchange, fewest violations, patience, largest violation, and steps.
    def step(state: tuple[Array, ...]) -> tuple[Array, ...]:
        _, free, wrong, fewest, patience, _, steps = state
        free = free ^ wrong
        reduced = jnp.where(free[:, None] & free[None, :], hessian, jnp.diag(jnp.diagonal(hessian)))
        y = jax.scipy.linalg.solve(reduced, jnp.where(free, -linear, 0), assume_a="pos")
        violation = jnp.where(free, -y, -(hessian @ y + linear))
        wrong = violation > atol
        count = jnp.sum(wrong)
        patience = jnp.where(count < fewest, _PATIENCE, jnp.maximum(patience - 1, -1))
        last = jnp.arange(y.size) == jnp.max(jnp.where(wrong, jnp.arange(y.size), -1))
        exchanged = jnp.where(patience >= 0, wrong, last)
        left = jnp.maximum(jnp.max(violation), 0)
        return jnp.maximum(y, 0), free, exchanged, jnp.minimum(count, fewest), patience, left, steps + 1

    def goes_on(state: tuple[Array, ...]) -> Bool[Array, ""]:
        # A comparison with NaN must end the search too.
        return (state[5] > atol) & (state[6] < most_steps) & jnp.all(jnp.isfinite(state[0]))

    far = jnp.asarray(jnp.inf, dtype=start.dtype)
    counts = jnp.asarray(start.size + 1), jnp.asarray(_PATIENCE)
    first: tuple[Array, ...] = start, start > 0, jnp.zeros_like(start, dtype=bool), *counts, far, jnp.asarray(0)
    y, *_, left, _ = lax.while_loop(goes_on, step, first)
    return y, (left <= atol) & jnp.all(jnp.isfinite(y))


def pivot_nonnegative(
    hessian: np.ndarray, linear: np.ndarray, start: np.ndarray, atol: float, most_steps: int
) -> tuple[np.ndarray, bool]:
    """The same for one quadratic in NumPy, which compiles nothing."""
    free, wrong, fewest, patience = start > 0, np.zeros(len(start), dtype=bool), len(start) + 1, _PATIENCE
    y, left = start, np.inf
    for _ in range(most_steps):
        free = free ^ wrong
        y = np.zeros_like(start)
        try:
            y[free] = scipy.linalg.cho_solve(scipy.linalg.cho_factor(hessian[np.ix_(free, free)]), -linear[free])
        except (np.linalg.LinAlgError, ValueError):
            return np.full_like(start, np.nan), False
        violation = np.where(free, -y, -(hessian @ y + linear))
        wrong, left, y = violation > atol, float(violation.max()), np.maximum(y, 0)
        if left <= atol:
            break
        count = int(wrong.sum())
        patience = _PATIENCE if count < fewest else max(patience - 1, -1)
        fewest = min(count, fewest)
        if patience < 0:
            wrong[: np.flatnonzero(wrong)[-1]] = False
    return y, left <= atol
