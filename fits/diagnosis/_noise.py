"""The noise of each run, and faults of single samples: spikes, the last digit, jitter and narrow bands."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import median_filter, rank_filter

from fits.diagnosis._projector import Projector
from fits.diagnosis._regression import Regression
from fits.diagnosis._thresholds import THRESHOLDS, Thresholds
from fits.io._record import Record
from fits.loop._run import Run
from fits.stats._noise import Noise, idle_stretches, learn_noise, quantum_um, rough_noise_um, stretches
from fits.stats._noise_spectrum import DRIFT, Band, MAINS_Hz, band_of
from microid.effects import Statistic

# So many samples at rest are enough to read the noise from.
_IDLE = 150
# Lines of mains are looked for in stretches of at least so many samples, and no longer than stay in step, in s.
_LONG, _STEADY_s = 60, 1.5
# At most so many spikes stand together, and the other samples up to so far away are much smaller.
_MOST_TOGETHER, _COMPARED_SAMPLES = 3, 16
# A command that moves, or turns, by more than these parts of its range within so many samples may cause what looks
# like a spike.
_MOVED_SHARE, _TURNED_SHARE, _SAMPLES_AROUND = 0.02, 0.004, 6
# There a spike is larger than this multiple of what is usual.
_OUTLYING = 2.0
# So many spikes are no chance.
_FEWEST_SPIKES = 3
# Jitter beside rounding has at least so many times its variance.
_ROUNDING = 10.0
# A band is one of a resonance from this quality on; what is broader wanders, or jumps.
_NARROW = 1.5


@dataclass(frozen=True)
class Floor:
    """What a run's noise is, whatever a model leaves, and how many `idle` samples it was read off; 0 for none."""

    noise: Noise
    idle: int


def floor_of(run: Run, residual_um: np.ndarray, settling_s: float, thresholds: Thresholds = THRESHOLDS) -> Floor:
    """Read the noise of a run off its idle stretches, or off the fastest changes of the residual.

    A stretch is idle once the stage has settled, which takes it `settling_s`.
    """
    pieces = []
    for stretch in idle_stretches(run.record.voltage_V, round(settling_s * run.rate_Hz)):
        piece = residual_um[stretch]
        time = np.linspace(-1, 1, len(piece))
        # What settles is no noise.
        pieces.append(piece - np.polyval(np.polyfit(time, piece, min(3, len(piece) // 12)), time))
    if sum(len(piece) for piece in pieces) >= _IDLE:
        pieces = _without_mains(pieces, 1 / run.rate_Hz, 1 - thresholds.minor_share)
        joined = np.concatenate(pieces)
        if (rough_um := rough_noise_um(joined)) > 0:
            joined = joined[np.abs(joined) < 8 * rough_um + 1e-300]
        freedom = 4.0 * len(pieces)
        level = float(np.std(joined)) * (len(joined) / max(len(joined) - freedom, 1)) ** 0.5
        correlation = float(np.mean(joined[1:] * joined[:-1]) / max(np.mean(joined**2), 1e-300))
        if level > 0:
            correlated = abs(correlation) * len(joined) ** 0.5 > thresholds.apart_z
            return Floor(learn_noise(joined, freedom) if correlated else _white(level), len(joined))
    used = residual_um[run.fitted]
    return Floor(_white(max(rough_noise_um(used), 1e-9 * float(np.ptp(run.displacement_um)))), 0)


def _white(level_um: float) -> Noise:
    return Noise(level_um, np.zeros(0))


def pooled(floors: Sequence[Floor], same_z: float = THRESHOLDS.apart_z) -> list[Floor]:
    """Floors of one sensor: white noise that was read off idle stretches, and is the same in all runs by chance."""
    white = [floor.idle > 0 and len(floor.noise.past) == 0 for floor in floors]
    if sum(white) < 2:
        return list(floors)
    counts = np.array([floor.idle for floor in floors])[white]
    levels = np.array([floor.noise.innovation_um for floor in floors])[white]
    level = float(np.sqrt(np.average(levels**2, weights=counts)))
    if np.any(np.abs(levels / level - 1) > same_z / np.sqrt(2 * counts)):
        return list(floors)
    return [replace(one, noise=_white(level)) if own else one for one, own in zip(floors, white, strict=True)]


def _without_mains(pieces: list[np.ndarray], interval_s: float, most_left: float) -> list[np.ndarray]:
    """Take the lines of mains out of stretches, where they are most of what is there: hum is a cause, not noise."""
    most, long = max(round(_STEADY_s / interval_s), _LONG), []
    for piece in pieces:
        if len(piece) >= _LONG:
            long += np.array_split(piece, max(len(piece) // most, 1))
    if sum(len(piece) for piece in long) < _IDLE:
        return pieces
    best, found = most_left * sum(float(piece @ piece) for piece in long), pieces
    for mains in MAINS_Hz:
        for frequency in mains * (1 + np.linspace(-DRIFT, DRIFT, 9)):
            left = []
            for piece in long:
                phase = 2 * np.pi * frequency * interval_s * np.arange(len(piece))
                lines = np.stack([wave(h * phase) for h in (1, 2, 3) for wave in (np.cos, np.sin)], axis=1)
                left.append(piece - lines @ np.linalg.lstsq(lines, piece, rcond=None)[0])
            rest = sum(float(piece @ piece) for piece in left)
            if rest < best:
                best, found = rest, left
    return found


def spikes(
    run: Run, residual_um: np.ndarray, least_um: float = 0.0, spike_z: float = THRESHOLDS.spike_z
) -> np.ndarray:
    """Samples that stand alone, far off their neighbours, where the command gives no reason; shape `(n,)`."""
    size = np.abs(residual_um - median_filter(residual_um, 7, mode="nearest"))
    spread = np.maximum(1.4826 * median_filter(size, 101, mode="nearest"), 1.4826 * float(np.median(size)))
    far = size > np.maximum(spike_z * spread, least_um + 1e-300)
    # What rings has neighbours as large; what is alone has none, or one of its kind by chance.
    # In two dimensions: in one, SciPy 1.17 takes a footprint with a gap for one without.
    beside = np.abs(np.arange(-_COMPARED_SAMPLES, _COMPARED_SAMPLES + 1))[None] > _MOST_TOGETHER
    far &= size > 3 * rank_filter(size[None], -2, footprint=beside, mode="nearest")[0]
    voltage = run.record.voltage_V
    change = np.diff(voltage, prepend=voltage[0])
    turned = np.abs(np.diff(change, append=change[-1])) > _TURNED_SHARE * float(np.ptp(voltage))
    moved = (np.abs(change) > _MOVED_SHARE * float(np.ptp(voltage))) | turned
    width = 2 * _SAMPLES_AROUND + 1
    near = np.convolve(moved, np.ones(width), mode="same") > 0.5
    # Where it may, others do so, too: one sample in fifty, and one in a tenth of the places.
    places = [slice(k, min(k + width, stop)) for first, stop in stretches(near) for k in range(first, stop, width)]
    if places:
        usual = _OUTLYING * float(np.quantile(size[near], 0.98))
        usual = max(usual, float(np.quantile([size[place].max() for place in places], 0.9)))
        far &= ~near | (size > _OUTLYING * usual)
    for first, stop in stretches(far):
        if stop - first > _MOST_TOGETHER:
            far[first:stop] = False
    return far


def jitter_s(
    residual_um: np.ndarray, rate_um_per_s: np.ndarray, least_um: float = 0.0, apart_z: float = THRESHOLDS.apart_z
) -> tuple[float, float, float]:
    """Jitter of the instants of sampling, its evidence in standard deviations, and the most that it may be.

    It is noise that grows with the speed: the variance about the neighbours is compared with the square of the speed.
    """
    bent = residual_um[1:-1] - (residual_um[2:] + residual_um[:-2]) / 2
    square = bent**2 / 1.5
    speed = rate_um_per_s[1:-1] ** 2
    order = np.argsort(speed)
    slow, quick = order[: len(order) // 2], order[-len(order) // 10 :]
    base = max(float(np.median(square[slow])) / 0.4549, least_um**2)
    more = float(np.median(square[quick])) / 0.4549 - base
    # The slower half jitters, too.
    faster = float(np.median(speed[quick]) - np.median(speed[slow]))
    if base <= 0 or faster <= 0:
        return 0.0, 0.0, float("inf")
    # The median of a chi-square variable has a relative standard error of about 1.6 / sqrt(n).
    error = 1.65 * np.hypot(base / len(slow) ** 0.5, (base + more) / len(quick) ** 0.5)
    most = float((max(more + apart_z * error, 0.0) / faster) ** 0.5)
    # Rounding is less where nothing moves, and there its median is not that of normal noise.
    if more <= _ROUNDING * least_um**2:
        return 0.0, 0.0, most
    return float((more / faster) ** 0.5), float(more / error), most


@dataclass(frozen=True)
class Faults:
    """What is wrong with samples, and what the noise of each run is, learnt from `source`, in words.

    Bad samples of each run are `spikes`, and `heights_um` how far off they are, shape `(n,)`. `quantum_um` is the
    last digit of the sensor, the largest of all runs, 0 for none; `jitter_um` what the jitter of the instants of
    sampling makes in the readings; `band` the strongest narrow band of all runs.
    """

    noise: tuple[Noise, ...]
    source: str
    spikes: tuple[np.ndarray, ...]
    heights_um: tuple[np.ndarray, ...]
    quantum_um: float
    jitter_s: float
    jitter_um: float
    jitter_z: float
    band: Band
    remarks: tuple[str, ...] = ()

    @property
    def repaired(self) -> bool:
        """Whether there are enough spikes to be taken out."""
        return sum(int(s.sum()) for s in self.spikes) >= _FEWEST_SPIKES

    def clean(self, records: Sequence[Record]) -> list[Record]:
        """Take the spikes out of records."""
        if not self.repaired:
            return list(records)
        return [
            replace(record, displacement_um=np.asarray(record.displacement_um) - height)
            for record, height in zip(records, self.heights_um, strict=True)
        ]


def find_faults(
    regression: Regression, change_um: Sequence[np.ndarray] | None = None, thresholds: Thresholds = THRESHOLDS
) -> Faults:
    """Look at what a fitted plain stage leaves of each run, sample by sample.

    Where effects are known, `change_um` is what they change in each run, shape `(n,)`, and is taken off before.
    """
    if change_um is not None:
        left = tuple(r - change for r, change in zip(regression.residuals, change_um, strict=True))
        regression = replace(regression, residuals=left)
    baseline = regression.baseline
    used = (left[mask] for left, mask in zip(regression.residuals, regression.masks, strict=True))
    guess = [_white(max(rough_noise_um(left), 1e-9 * baseline.stroke_um)) for left in used]
    projector = Projector(regression, guess)
    dz, dw = projector.step(projector.residual)
    quantum = max(quantum_um(run.displacement_um) for run in baseline.runs)
    # Rounding is noise that a command at rest does not show.
    least = quantum / 12**0.5
    floors, found, heights, jitters, bands = [], [], [], [], []
    poles = np.asarray(baseline.stage.poles_rad_per_s).real if baseline.dynamic else np.zeros(0)
    # After so many e-folds a motion has settled.
    settling_s = float(8.0 / max(np.min(np.abs(poles)), 1e-3)) if len(poles) else 0.0
    each = zip(baseline.runs, regression.rows, regression.nuisance, regression.residuals, strict=True)
    for run, rows, nuisance, residual in each:
        moved = residual - rows @ np.concatenate([dw, dz])
        mask = run.fitted
        left = moved - nuisance @ np.linalg.lstsq(nuisance[mask], moved[mask], rcond=None)[0]
        bad = spikes(run, left, 2 * quantum, thresholds.spike_z)
        smooth = np.interp(np.arange(len(left)), np.flatnonzero(~bad), left[~bad]) if bad.any() else left
        found.append(bad)
        heights.append(np.where(bad, left - smooth, 0.0))
        floors.append(floor_of(run, smooth, settling_s, thresholds))
        rate = np.gradient(run.displacement_um - left, run.record.time_s)
        size, z, most = jitter_s(smooth[mask], rate[mask], least, thresholds.apart_z)
        jitters.append((z, size, np.abs(rate), most))
        interval = float(np.median(np.diff(run.record.time_s)))
        bands.append(band_of(smooth[mask], interval, run.record.voltage_V[mask]))
    floors = pooled(floors, thresholds.apart_z)
    noise = [one.noise if one.noise.total_um > least else _white(least) for one in floors]
    z, size, _, _ = max(jitters, key=lambda j: j[0])
    # One recorder took all runs: what only one of them shows is something else.
    z = z if size / 2 < min(most for _, _, _, most in jitters) else 0.0
    if z > thresholds.strong_z:
        noise = [
            replace(n, spread=np.sqrt(1 + (size * rate / n.innovation_um) ** 2))
            for n, (_, _, rate, _) in zip(noise, jitters, strict=True)
        ]
    # What may be hum in one run may be told from it in another.
    band = max(bands, key=lambda one: (not one.mains, one.z))
    source = "idle stretches where there are any, and the fastest changes of the residual elsewhere"
    if all(floor.idle for floor in floors):
        source = "idle stretches of the runs"
    elif not any(floor.idle for floor in floors):
        source = "the fastest changes of the residual, as if it were white"
    size = size if z > thresholds.strong_z else 0.0
    made = size * float(np.sqrt(np.mean(np.concatenate([rate for _, _, rate, _ in jitters]) ** 2)))
    return Faults(tuple(noise), source, tuple(found), tuple(heights), quantum, size, made, z, band)


@dataclass(frozen=True)
class Fault:
    """A fault of samples or noise that is a cause of its own, and its parameters with standard deviations."""

    statistic: Statistic
    z: float
    parameters: tuple[tuple[str, float, float, str], ...]
    variance_um2: float


def name_faults(faults: Faults, cyclic: bool, thresholds: Thresholds = THRESHOLDS) -> list[Fault]:
    """Which of them explain enough of what is left; what repeats itself with the position (`cyclic`) is no jitter."""
    found = []
    total = float(np.mean([n.total_um**2 for n in faults.noise]))
    bad = np.concatenate(faults.spikes)
    samples, count = len(bad), int(bad.sum())
    if count >= _FEWEST_SPIKES:
        heights = np.concatenate(faults.heights_um)[bad]
        size = float(np.sqrt(np.mean(heights**2)))
        share, z = count / samples, float(np.max(np.abs(heights)) / total**0.5)
        known = ("fraction", share, count**0.5 / samples, "1"), ("size_um", size, size / (2 * count) ** 0.5, "um")
        found.append(Fault("spikes", z, known, share * size**2))
    step = faults.quantum_um
    if step**2 / 12 > thresholds.minor_share * total:
        z = (samples * step**2 / 12 / total) ** 0.5
        found.append(Fault("rounding", z, (("step_um", step, 1e-6 * step, "um"),), step**2 / 12))
    if faults.jitter_s > 0 and not cyclic:
        jitter = "jitter_s", faults.jitter_s, faults.jitter_s / (2 * max(faults.jitter_z, 1e-9)), "s"
        found.append(Fault("jitter", faults.jitter_z, (jitter,), faults.jitter_um**2))
    band = faults.band
    narrow = band.z > thresholds.strong_z and band.quality > _NARROW
    if narrow and band.size_um**2 > thresholds.minor_share / 3 * total and not band.mains:
        middle = "frequency_Hz", band.frequency_Hz, band.frequency_Hz / band.quality, "Hz"
        size_of_band = "amplitude_um", band.size_um, band.sd_um, "um"
        found.append(Fault("band", band.z, (size_of_band, middle), band.size_um**2))
    return found
