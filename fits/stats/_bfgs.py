"""Smooth functions of a few variables: the quasi-Newton method of Broyden, Fletcher, Goldfarb and Shanno."""

from collections.abc import Callable

import numpy as np

# A step is halved until it gains such a part of what the slope at its start promises (Armijo's condition).
_GAIN = 0.1


def minimise(
    value: Callable[[np.ndarray], float],
    slope: Callable[[np.ndarray], np.ndarray],
    start: np.ndarray,
    rtol: float,
    atol: float,
    most_values: int,
) -> np.ndarray:
    """Go down from a start, shape `(k,)`, to where steps and gains are small, or as far as so many values lead.

    A step counts as small where each variable, and the value, change by less than `atol` and `rtol` of their size.
    The rule is that of Nocedal & Wright, Numerical Optimization (2006), Eq. 6.17. Where the function is not finite
    steps are halved, too. SciPy's method goes on until the slope is small, which rounding may keep it from.
    """
    x, unit, step = start, np.eye(len(start)), 1.0
    now, downhill, inverse = value(x), slope(x), unit
    for _ in range(most_values - 1):
        move = -step * (inverse @ downhill)
        there, promised = value(x + move), float(downhill @ move)
        if not (promised <= 0 and there - now <= _GAIN * promised):
            step /= 2
            continue
        x, gained, step, before = x + move, there - now, 1.0, downhill
        now, downhill = there, slope(x)
        bend = downhill - before
        along = float(bend @ move)
        if along > np.finfo(float).eps:
            off = unit - np.outer(move, bend) / along
            inverse = off @ inverse @ off.T + np.outer(move, move) / along
        small = np.all(np.abs(move) < atol + rtol * np.abs(x)) and abs(gained) < atol + rtol * abs(now)
        if small:
            break
    return x
