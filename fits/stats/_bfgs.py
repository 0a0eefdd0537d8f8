"""Smooth functions of a few variables: SciPy's quasi-Newton method, ended as Optimistix ends its own."""

from collections.abc import Callable
from typing import Any

import numpy as np
import scipy


def minimise(
    both: Callable[[np.ndarray], tuple[float, np.ndarray]],
    start: np.ndarray,
    rtol: float,
    atol: float,
    most_steps: int,
    cold: bool = False,
) -> np.ndarray:
    """Go down from a start, shape `(k,)`, to where steps and gains are small, or as far as so many steps lead.

    `both` gives the value and its derivatives, `(k,)`. A step counts as small where each variable, and the value,
    change by less than `atol` and `rtol` of their size. By itself SciPy goes on until the slope is small, which
    rounding may keep it from. A first step from a `cold` start may be small because it is along what is known best:
    it ends nothing. What is not finite is too far.
    """
    before, now = start, np.inf if cold else both(start)[0]

    def end(intermediate_result: Any) -> None:
        nonlocal before, now
        x, reached = np.array(intermediate_result.x), float(intermediate_result.fun)
        moved, gained = np.abs(x - before), abs(reached - now)
        before, now = x, reached
        if np.all(moved < atol + rtol * np.abs(x)) and gained < atol + rtol * abs(reached):
            raise StopIteration

    def finite(x: np.ndarray) -> tuple[float, np.ndarray]:
        value, slope = both(x)
        return value if np.isfinite(value) else np.inf, slope

    options = {"maxiter": most_steps, "gtol": 0.0}
    found = scipy.optimize.minimize(finite, start, jac=True, method="BFGS", callback=end, options=options)
    return np.asarray(found.x)
