"""How far a residual is from noise, and what is wrong with records: sensors that stick, outliers, odd times."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from fits.io._length import length
from fits.io._record import Record
from fits.loop._run import Run
from fits.stats._noise import idle_stretches, quantum_um, rough_noise_um, stretches

# A sensor sticks where so many readings in a row are the same to the last bit.
_STUCK_SAMPLES = 8
# Meanwhile the stage, by its mean gain, moves by such a part of its stroke, and by so many last digits.
_MOVED_SHARE, _DIGITS = 0.05, 3.0
# A voltage is at an end of its range within this part of it; a first way of so many samples is told from what follows
# where it is off by so many times as much.
_AT_END, _FEWEST, _FRESH = 0.02, 20, 4.0
# So many impulses are no chance; so many are listed.
_FEW, _LISTED = 3, 6


@dataclass(frozen=True)
class Misfit:
    """What a fit leaves of the run that it describes worst, against what the sensor's noise would leave.

    `residual_um` is the root mean square over the fitted samples, `share_pct` the same in % of the run's stroke, and
    `noise_um` the standard deviation of the sensor's noise, its last digit included, read off what `shown_by` says.
    """

    source: str
    residual_um: float
    share_pct: float
    noise_um: float
    shown_by: str

    @property
    def times_noise(self) -> float:
        """How many times the noise the residual is."""
        return self.residual_um / self.noise_um

    @property
    def far(self) -> bool:
        """Whether more than noise is left, and more than a trifle of the stroke."""
        return self.times_noise > 2.0 and self.share_pct > 0.1


def misfits(runs: Sequence[Run], residuals: Sequence[np.ndarray]) -> list[Misfit]:
    """Compare the residual of each run, in um, with the noise of the sensor, which is that of its quietest run."""
    noise, shown_by = min(
        (sensor_noise_um(run.record, residual) for run, residual in zip(runs, residuals, strict=True)),
        key=lambda one: one[0],
    )
    out = []
    for run, residual in zip(runs, residuals, strict=True):
        left = residual[run.fitted] - residual[run.fitted].mean()
        rms = float(np.sqrt(np.mean(left**2)))
        stroke = float(np.ptp(run.displacement_um[run.fitted]))
        out.append(Misfit(run.record.source, rms, 100 * rms / max(stroke, 1e-300), noise, shown_by))
    return out


def worst(found: Sequence[Misfit]) -> Misfit:
    """The run that is furthest from noise."""
    return max(found, key=lambda one: (one.far, one.times_noise))


def compare_gains(moved_um: Sequence[np.ndarray], left_um: Sequence[np.ndarray]) -> tuple[int, int, float]:
    """The runs that move most and least for what a model says they move, by what it leaves, and their ratio."""
    gains = []
    for moved, left in zip(moved_um, left_um, strict=True):
        moved = moved - moved.mean()
        gains.append(1 + float(moved @ left / max(moved @ moved, 1e-300)))
    low, high = int(np.argmin(gains)), int(np.argmax(gains))
    return high, low, gains[high] / gains[low] if gains[low] > 0 else np.inf


def sensor_noise_um(record: Record, residual_um: np.ndarray) -> tuple[float, str]:
    """Standard deviation of a sensor's noise, whatever a model leaves, and what shows it.

    Where the command rests long enough it is that of the readings there; elsewhere that of the fastest changes of the
    readings, or of what a fit leaves of them, as if noise were white. No less than the last digit makes.
    """
    reading = record.displacement_um
    assert reading is not None
    pieces = []
    for stretch in idle_stretches(record.voltage_V, 0):
        piece = reading[stretch]
        time = np.linspace(-1, 1, len(piece))
        # What settles is no noise.
        pieces.append(piece - np.polyval(np.polyfit(time, piece, min(3, len(piece) // 12)), time))
    found = []
    if sum(map(len, pieces)) >= 150:  # samples at rest say what the noise is
        joined = np.concatenate(pieces)
        found.append((1.4826 * float(np.median(np.abs(joined))), f"{record.source} at rest"))
    words = f"the fastest changes in {record.source}"
    found += [(rough_noise_um(values), words) for values in (reading, residual_um)]
    digit = quantum_um(reading) / 12**0.5
    least = max(digit, 1e-7 * float(np.ptp(reading)))
    noise, shown_by = min(found, key=lambda one: one[0])
    return (noise, shown_by) if noise >= least else (least, f"the last digit in {record.source}")


def remarks_on(runs: Sequence[Run], residuals: Sequence[np.ndarray], robust: bool) -> list[str]:
    """Name what is wrong with fitted runs, by their residuals in um, `(n,)`; `robust` if outliers count less."""
    out = []
    for run, residual in zip(runs, residuals, strict=True):
        record = run.record
        out += stuck(record)
        out += impulses(run, residual, robust)
        out += first_way(run, residual)
        interval = float(np.median(np.diff(record.time_s)))
        if interval > 1.0:
            out.append(
                f"{record.source}: samples are {interval:.4g} s apart and the run takes {record.duration_s:.4g} s, "
                "which is rare with piezo stages: if the time is in ms, name it so among the columns, time_s=NAME[ms]"
            )
    return out


def first_way(run: Run, residual_um: np.ndarray) -> list[str]:
    """Whether the first way across the range is off by far more than what follows, as that of a fresh stage is.

    A hysteresis that is fitted knows only of voltages within the range of its runs.
    """
    voltage_V = run.record.voltage_V
    share = (voltage_V - voltage_V.min()) / max(float(np.ptp(voltage_V)), 1e-300)
    stop = max(int(np.argmax(share < _AT_END)), int(np.argmax(share > 1 - _AT_END)))
    first, later = (run.fitted & each for each in (np.arange(share.size) < stop, np.arange(share.size) >= stop))
    if min(first.sum(), later.sum()) < _FEWEST:
        return []
    off_um = residual_um - residual_um[later].mean()
    early, late = (float(np.sqrt(np.mean(off_um[part] ** 2))) for part in (first, later))
    if early < _FRESH * late:
        return []
    return [
        f"{run.record.source}: up to sample {stop} ({run.record.time_s[stop] - run.record.time_s[0]:.4g} s), on the "
        f"first way across the range of the voltage, readings are off by {length(early)} rms, and later by "
        f"{length(late)}: a stage that is fresh, or was beyond this range before, begins elsewhere; leave these "
        "samples out"
    ]


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
        bad &= height > 0.2 * float(np.sqrt(np.mean(height[bad] ** 2)))
    if bad.sum() < _FEW or np.sum(height[bad] ** 2) < 0.1 * np.sum(residual_um[fitted] ** 2):
        return np.zeros_like(bad)
    return bad


def _height(residual_um: np.ndarray) -> np.ndarray:
    return np.abs(residual_um - scipy.ndimage.median_filter(residual_um, 7, mode="nearest"))


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
        else "they pull the fit: fit again with the loss huber, to which they count less, or leave them out"
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
    mended = np.where(bad, scipy.ndimage.median_filter(reading, 7, mode="nearest"), reading)
    return replace(record, displacement_um=mended)


def impulsive(residual_um: np.ndarray, digit_um: float = 0.0) -> np.ndarray:
    """Mark readings that are far off their neighbours, in last digits, too, shape `(n,)`."""
    off = _height(residual_um)
    spread = np.maximum(scipy.ndimage.median_filter(off, 101, mode="nearest"), max(float(np.median(off)), digit_um))
    far = off > 8.0 * 1.4826 * spread + 1e-300  # eight standard deviations
    # What rings, or turns back, goes on as fast as it came: its neighbours move about as far from sample to sample.
    steps = np.abs(np.diff(residual_um, append=residual_um[-1]))
    far &= off > 4.0 * scipy.ndimage.median_filter(steps, 33, mode="nearest")
    for first, stop in stretches(far):
        if stop - first > 3:  # more do not jump back
            far[first:stop] = False
    return far
