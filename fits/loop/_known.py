"""Which samples of a run depend on what the rig went through before, and of which runs that is estimated."""

from collections.abc import Sequence

import numpy as np

from fits.io._record import Record
from fits.loop._prediction import Initial

# A voltage has been at an end once it comes this close, as a part of the range.
_AT_END = 0.01
# A past is estimated that more than this part of a record's samples depends on, in a fit of loops alone, and in one
# of a stage, whose poles are read off much smaller errors than that of the estimate.
SOME, MOST = 0.05, 0.5


def known_samples(voltage: np.ndarray, lower_V: float, upper_V: float, initial: Initial = "unknown") -> np.ndarray:
    """Mark what no longer depends on a past that is `initial`, one of `INITIAL_STATES`.

    At an end of the range every relay is in a known state, unless it cannot be switched back within the range. Short
    of that, relays outside the extremes that this run itself reaches either never switch or switch on the way to
    them; once both have been visited they are a constant, which the run's own offset takes up.
    """
    if initial != "unknown":
        return np.ones(len(voltage), dtype=bool)
    highest, lowest = np.maximum.accumulate(voltage), np.minimum.accumulate(voltage)
    found: list[np.ndarray] = []
    # How near to an end or an own extreme, as a fraction of the range, has met it: peaks of smooth commands miss ends
    # by a little, and the first that does not cost most of the samples is taken.
    for share in (1e-3, 3e-3, 1e-2):
        near = share * (upper_V - lower_V)
        saturated = (lowest <= lower_V + near) | (highest >= upper_V - near)
        own = near if found else 0.0
        both = (highest >= voltage.max() - own) & (lowest <= voltage.min() + own)
        found.append(saturated | both)
    return next(known for known in found if 2 * known.sum() >= found[-1].sum())


def pasts_to_estimate(
    records: Sequence[Record], range_V: tuple[float, float], holdout: float, least: float | None = None
) -> tuple[bool, ...]:
    """Of which records, all in their order, the unknown past is estimated beside the rest.

    Of all, or of those that would lose more than the `least` part of their samples to it. What it adds stays as it is
    while the voltage stays within what it has reached: there the samples that are fitted must go up and down through
    the range, as otherwise nothing would be left beside it.
    """
    inside_V = np.concatenate([_moves_inside_V(record.voltage_V, holdout) for record in records])
    up_V, down_V = float(inside_V[inside_V > 0].sum()), -float(inside_V[inside_V < 0].sum())
    if min(up_V, down_V) < (1 - 2 * _AT_END) * (range_V[1] - range_V[0]):
        return (False,) * len(records)
    known = (known_samples(record.voltage_V, *range_V) for record in records)
    return tuple(least is None or float(np.mean(~one)) > least for one in known)


def _moves_inside_V(voltage_V: np.ndarray, holdout: float) -> np.ndarray:
    """Steps of what is not held out of a voltage that end within what it has reached before."""
    fitted = voltage_V[: len(voltage_V) - round(holdout * len(voltage_V))]
    highest, lowest = np.maximum.accumulate(fitted)[:-1], np.minimum.accumulate(fitted)[:-1]
    return np.diff(fitted)[(fitted[1:] <= highest) & (fitted[1:] >= lowest)]
