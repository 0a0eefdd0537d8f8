"""Creep as runs show it in which a controller held the displacement: in what it took back."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from fits.io._record import Record

# A hold lasts so long and has so many samples.
_LONG_s, _SAMPLES = 1.0, 200
# Meanwhile the displacement keeps within this part of its range, and the voltage moves by more than that of its own.
_AT_REST_SHARE, _MOVED_SHARE = 3e-3, 5e-3
# The voltage is read from so many intervals after the beginning on, in so many blocks, evenly spaced in the logarithm
# of time, over so many decades at least.
_AFTER, _BLOCKS, _DECADES = 8, 24, 2.0
# Part of the scatter about its mean that a line over the logarithm of time must explain.
_STRAIGHT = 0.97


@dataclass(frozen=True)
class Held:
    """What a controller took back while it held the displacement for `duration_s`.

    `gain_per_decade` is the change of the voltage per decade of time over the step before, against it.
    """

    source: str
    duration_s: float
    gain_per_decade: float
    sd: float

    @property
    def sentence(self) -> str:
        """What is to be said of it."""
        return (
            f"{self.source}: a controller held the displacement for {self.duration_s:.3g} s, in which the voltage "
            f"went back by {self.gain_per_decade:.2%} of the step before with each decade of time; that is the gain "
            "of its creep, which the fit cannot tell from a density without slope there"
        )


def held_gain(records: Sequence[Record]) -> Held | None:
    """Read the gain off the hold that shows it best; None where no controller held the displacement."""
    found = [held for record in records for held in _holds(record)]
    return min(found, key=lambda held: held.sd / held.gain_per_decade, default=None)


def _holds(record: Record) -> list[Held]:
    assert record.displacement_um is not None
    time, voltage, place = record.time_s, record.voltage_V, record.displacement_um
    close, apart = _AT_REST_SHARE * float(np.ptp(place)), _MOVED_SHARE * float(np.ptp(voltage))
    out = []
    for first, stop in _stretches_at_rest(place, close):
        if stop - first < _SAMPLES or time[stop - 1] - time[first] < _LONG_s:
            continue
        if np.ptp(voltage[first:stop]) < apart or np.ptp(np.diff(voltage[first:stop])) == 0:
            continue
        # The step before began at the other extreme, and ended where the voltage turned back.
        before = voltage[: first + 1]
        far = before[np.argmax(np.abs(before - voltage[first]))]
        first += int(np.argmax(np.abs(voltage[first:stop] - far)))
        age = time[first:stop] - time[first]
        step = float(voltage[first] - far)
        late = age > _AFTER * float(np.median(np.diff(time)))
        decades = np.log10(age[late][-1] / age[late][0]) if late.any() else 0.0
        if step == 0 or decades < _DECADES:
            continue
        slope, sd, straight = _regressed(np.log10(age[late]), voltage[first:stop][late])
        if straight > _STRAIGHT and -slope / step > 0:
            out.append(Held(record.source, float(age[-1]), -slope / step, sd / abs(step)))
    return out


def _stretches_at_rest(place: np.ndarray, close: float) -> list[tuple[int, int]]:
    """Longest stretches within which values keep within a band, one after the other."""
    found, first = [], 0
    while first + _SAMPLES <= len(place):
        if np.ptp(place[first : first + _SAMPLES]) > close:
            first += _SAMPLES // 8
            continue
        low, high = np.minimum.accumulate(place[first:]), np.maximum.accumulate(place[first:])
        away = np.flatnonzero(high - low > close)
        stop = first + (int(away[0]) if len(away) else len(place) - first)
        # Windows are laid in steps: the stretch may have begun before.
        inside, before = place[first:stop], place[:first]
        off = np.flatnonzero(np.maximum(before, inside.max()) - np.minimum(before, inside.min()) > close)
        found.append((int(off[-1]) + 1 if len(off) else 0, stop))
        first = stop
    return found


def _regressed(along: np.ndarray, values: np.ndarray) -> tuple[float, float, float]:
    """Slope over blocks that are evenly spaced, its standard deviation, and the part of the scatter explained."""
    edges = np.linspace(along[0], along[-1], _BLOCKS + 1)
    block = np.clip(np.searchsorted(edges, along, side="right") - 1, 0, _BLOCKS - 1)
    x, y = np.array([(along[block == k].mean(), values[block == k].mean()) for k in np.unique(block)]).T
    line = scipy.stats.linregress(x, y)
    # Neighbouring blocks err alike: only every other is taken to be of its own.
    return float(line.slope), float(2**0.5 * line.stderr), float(line.rvalue**2)
