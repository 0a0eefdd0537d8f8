"""What is wrong with records themselves: sensors that stick, readings that jump out and back, times in odd units."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.ndimage import median_filter

from fits.io._record import Record
from fits.loop._run import Run
from fits.stats._noise import quantum_um, stretches

# A sensor sticks where so many readings in a row are the same to the last bit.
_STUCK_SAMPLES = 8
# Meanwhile the stage, by its mean gain, moves by such a part of its stroke, and by so many last digits.
_MOVED_SHARE, _DIGITS = 0.05, 3.0
# Readings count as impulses beyond so many deviations from their neighbours, where at most so many stand together.
_IMPULSE, _MOST_TOGETHER = 8.0, 3
# They are so many times as large as the median of those within so many samples.
_LEAST_RATIO, _COMPARED_SAMPLES = 4.0, 16
# So many impulses are no chance; so many are listed.
_FEW, _LISTED = 3, 6
# Impulses count where they make such a part of the residual's squares.
_MATTERS = 0.1
# And are so large, beside the root mean square of all.
_PULLED = 0.2
# Samples farther apart than this, in s, are rare with piezo stages.
_SPARSE_s = 1.0


def remarks_on(runs: Sequence[Run], residuals: Sequence[np.ndarray], robust: bool) -> list[str]:
    """Name what is wrong with fitted runs, by their residuals in um, `(n,)`; `robust` if outliers count less."""
    out = []
    for run, residual in zip(runs, residuals, strict=True):
        record = run.record
        out += stuck(record)
        out += impulses(run, residual, robust)
        interval = float(np.median(np.diff(record.time_s)))
        if interval > _SPARSE_s:
            out.append(
                f"{record.source}: samples are {interval:.4g} s apart and the run takes {record.duration_s:.4g} s, "
                "which is rare with piezo stages: if the time is in ms, name it so, as in --columns time_s=time_ms"
            )
    return out


def stuck(record: Record) -> list[str]:
    """Find the longest stretch of readings that are the same to the last bit while the voltage moves."""
    reading, voltage = record.displacement_um, record.voltage_V
    assert reading is not None
    stroke, span = float(np.ptp(reading)), float(np.ptp(voltage))
    # Readings that stand at an end of the sensor's range are told of when they are read.
    inside = (reading[1:] > reading.min()) & (reading[1:] < reading.max())
    digit = quantum_um(reading)
    found = []
    for first, stop in stretches((np.diff(reading) == 0) & inside):
        moved = float(np.ptp(voltage[first : stop + 1]))
        moved_um = moved * stroke / span
        if stop + 1 - first >= _STUCK_SAMPLES and moved_um > max(_MOVED_SHARE * stroke, _DIGITS * digit):
            found.append((stop + 1 - first, first, moved))
    if not found:
        return []
    count, first, moved = max(found)
    when = f"{record.time_s[first]:.6g} to {record.time_s[first + count - 1]:.6g} s"
    others = "" if len(found) == 1 else f", and so are {len(found) - 1} shorter stretches"
    return [
        f"{record.source}: {count} readings in a row, samples {first + 1} to {first + count} ({when}), are "
        f"{reading[first]:.6g} um to the last bit while the voltage moves by {moved:.3g} V{others}: the sensor was "
        "stuck there; leave these samples out"
    ]


def outlying(residual_um: np.ndarray, fitted: np.ndarray) -> np.ndarray:
    """Mark readings far off their neighbours, where there are enough to matter to a fit, shape `(n,)`."""
    bad = impulsive(residual_um) & fitted
    height = _height(residual_um)
    if bad.any():
        # Where large ones pull the fit, what it leaves beside them jumps, too.
        bad &= height > _PULLED * float(np.sqrt(np.mean(height[bad] ** 2)))
    if bad.sum() < _FEW or np.sum(height[bad] ** 2) < _MATTERS * np.sum(residual_um[fitted] ** 2):
        return np.zeros_like(bad)
    return bad


def _height(residual_um: np.ndarray) -> np.ndarray:
    return np.abs(residual_um - median_filter(residual_um, 7, mode="nearest"))


def impulses(run: Run, residual_um: np.ndarray, robust: bool) -> list[str]:
    """Find single readings that are far off their neighbours, and name their number and size."""
    bad = outlying(residual_um, run.fitted)
    if not bad.any():
        return []
    count, height = int(bad.sum()), _height(residual_um)[bad]
    listed = ", ".join(str(k + 1) for k in np.flatnonzero(bad)[:_LISTED])
    more = ", ..." if count > _LISTED else ""
    remedy = (
        "they count less in this fit"
        if robust
        else "they pull the fit: fit again with --loss huber, to which they count less, or leave them out"
    )
    return [
        f"{run.record.source}: {count} readings ({100 * count / run.fitted.sum():.2g} %) jump out by "
        f"{np.median(height):.3g} um in the median and back, samples {listed}{more}: these are outliers; {remedy}"
    ]


def without_impulses(record: Record) -> Record:
    """The same record; readings that jump out and back are the median of those around them."""
    reading = record.displacement_um
    assert reading is not None
    bad = impulsive(reading, quantum_um(reading))
    if bad.sum() < _FEW:
        return record
    mended = np.where(bad, median_filter(reading, 7, mode="nearest"), reading)
    return replace(record, displacement_um=mended)


def impulsive(residual_um: np.ndarray, digit_um: float = 0.0) -> np.ndarray:
    """Mark readings that are far off their neighbours, in last digits, too, shape `(n,)`."""
    off = _height(residual_um)
    spread = np.maximum(median_filter(off, 101, mode="nearest"), max(float(np.median(off)), digit_um))
    far = off > _IMPULSE * 1.4826 * spread + 1e-300
    # What rings, or turns back, goes on as fast as it came: its neighbours move about as far from sample to sample.
    steps = np.abs(np.diff(residual_um, append=residual_um[-1]))
    far &= off > _LEAST_RATIO * median_filter(steps, 2 * _COMPARED_SAMPLES + 1, mode="nearest")
    for first, stop in stretches(far):
        if stop - first > _MOST_TOGETHER:
            far[first:stop] = False
    return far
