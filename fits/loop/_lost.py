"""Samples that were lost on the way: their readings are the one before them, written down again."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import scipy

from fits.io._record import Record
from fits.stats._noise import stretches

# Where readings go by more of the smallest step than this, no step from one to the next is much likelier than
# others.
_APART = 3.0
# Steps whose median is what a reading usually goes by, and the fewest that show it.
_AROUND, _FEWEST = 17, 50
# A sensor that repeats more of its readings is slower than its table says, or stuck.
_MOST = 0.2
# Steps as small as the smallest, as they come out rounded, are taken to be a few at least.
_ROUNDED, _CLOSE = 1.01, 3
# Samples were lost where chance repeats readings as often with this probability at most.
_CHANCE = 1e-3
_LOST = (
    "{}: {} readings ({:.2g} %) are the one before them to the last digit, while the stage moves on: these samples "
    "were lost, and the last reading was taken again; they are left out, so look at what reads the sensor"
)


def without_lost(
    records: Sequence[Record], holdout: float | Sequence[Record]
) -> tuple[tuple[Record, ...], float | tuple[Record, ...]]:
    """Mark the lost samples of runs, and of those held out, and put what may have been read there on a cubic spline.

    One recorder took all the runs, so that they are judged together. Filters that need every sample go on over them.
    """
    aside = () if isinstance(holdout, int | float) else tuple(holdout)
    found = [repeated(one) for one in (*records, *aside)]
    # Many in a row are one loss, or a sensor that sticks.
    count, close = sum(len(stretches(marks)) for marks, _ in found), sum(few for _, few in found)
    if not count or scipy.stats.nbinom.sf(count - 1, close, 0.5) > _CHANCE:
        return tuple(records), holdout if isinstance(holdout, int | float) else aside
    mended = tuple(_mended(one, marks) for one, (marks, _) in zip((*records, *aside), found, strict=True))
    records, aside = mended[: len(records)], mended[len(records) :]
    return records, holdout if isinstance(holdout, int | float) else aside


def _mended(record: Record, lost: np.ndarray) -> Record:
    if not lost.any():
        return record
    index, reading = np.arange(len(lost)), np.asarray(record.displacement_um)
    mended = scipy.interpolate.CubicSpline(index[~lost], reading[~lost])(index)
    said = _LOST.format(record.source or "a run", int(lost.sum()), 100 * float(lost.mean()))
    return replace(record, displacement_um=mended, lost=lost, warnings=(*record.warnings, said))


def repeated(record: Record) -> tuple[np.ndarray, int]:
    """Mark readings that are the one before them while the stage moves on, and count others that are close.

    Where the last digit is small no step at all is about as likely as one digit up, or one down: of these readings
    chance repeats a third, and less than half in any case.
    """
    readings_um, steps = np.asarray(record.displacement_um), np.abs(np.diff(np.asarray(record.displacement_um)))
    moved = np.flatnonzero(steps)
    if len(moved) < max(_FEWEST, (1 - _MOST) * len(steps)):
        return np.zeros(len(readings_um), dtype=bool), 0
    least_um = _ROUNDED * float(steps[moved].min())
    usual_um = scipy.ndimage.median_filter(steps[moved], _AROUND, mode="nearest")
    usual_um = np.interp(np.arange(len(steps)), moved, usual_um)
    asked, still = usual_um > _APART * least_um, np.diff(record.voltage_V) == 0
    if still.any() and np.mean(steps[still] == 0) > _MOST:
        # The stage stands still with its command, to the last digit.
        asked &= ~still
    # At an end of what a sensor reads all readings are the same.
    inside = (readings_um[1:] > readings_um.min()) & (readings_um[1:] < readings_um.max())
    close = asked & (steps > 0) & (steps <= least_um)
    return np.append(False, (steps == 0) & asked & inside), max(int(close.sum()), _CLOSE)
