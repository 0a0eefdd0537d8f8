"""From when on a run whose displacement lags its command no longer depends on an unknown past."""

import numpy as np
from scipy.ndimage import median_filter

# A command that has gone back by this part of its range before the displacement turns is lagged; closer is at an end.
_LAGS = 0.02
# Neighbours among which a reading that jumps out does not count as a turn.
_NEIGHBOURS = 5


def known_behind_lag(voltage_V: np.ndarray, displacement_um: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Leave out what comes before the displacement has turned where its command has.

    The hysteresis is driven by what lags the command, and turns later and short of it: only there its memory is that
    of the turn. Short of the ends of the range it is known once it has turned at both.

    Parameters
    ----------
    voltage_V, displacement_um
        The run, shape `(n,)`.
    known
        Samples that would not depend on the past if nothing lagged, shape `(n,)`.

    Returns
    -------
    ndarray
        The same, shape `(n,)`, or `known` itself where more than half of it would go.
    """
    if not known.any():
        return known
    first, range_V = int(np.argmax(known)), float(np.ptp(voltage_V))
    smooth_um = median_filter(displacement_um, _NEIGHBOURS, mode="nearest")
    middle_V = (voltage_V.max() + voltage_V.min()) / 2

    def turn(start: int) -> int:
        """Where the displacement turns after a command near an end, before that is half way back."""
        side = 1.0 if voltage_V[start] > middle_V else -1.0
        back = np.flatnonzero(side * (voltage_V[start:] - middle_V) <= 0)
        last = start + int(back[0]) if len(back) else len(voltage_V)
        return start + int(np.argmax(side * smooth_um[start:last])) if last > start else start

    at = turn(first)
    if abs(voltage_V[at] - voltage_V[first]) <= _LAGS * range_V:
        return known
    below = voltage_V[first] < middle_V
    other = (
        voltage_V >= voltage_V.max() - _LAGS * range_V if below else voltage_V <= voltage_V.min() + _LAGS * range_V
    )
    there = np.flatnonzero(other[at:])
    if len(there):
        at = turn(at + int(there[0]))
    later = known & (np.arange(len(known)) >= at)
    return later if 2 * later.sum() > known.sum() else known
