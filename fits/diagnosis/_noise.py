"""The noise of each run, and faults of single samples: spikes, the last digit, jitter and narrow bands."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from fits.diagnosis._projector import Projector
from fits.diagnosis._regression import Regression
from fits.diagnosis._thresholds import THRESHOLDS, Thresholds
from fits.io._record import Record
from fits.stats._band import Band, band_of, line_in, may_hold
from fits.stats._cycles import cycles, without_cycles
from fits.stats._noise import Noise, quantum_um, rough_noise_um
from fits.stats._sensor_noise import floor_of, jitter_s, pooled, spikes, white_noise
from microid.effects import Statistic

# So many spikes are no chance.
_FEWEST_SPIKES = 3
# Part of a spike off what the stage would leave, if it moved, that is in what it leaves.
_SEEN = 0.5


@dataclass(frozen=True)
class Faults:
    """What is wrong with samples, and what the noise of each run is, learnt from `source`, in words.

    Bad samples of each run are `spikes`, and `heights_um` how far off they are, shape `(n,)`; `repeats_um` is how far
    those were off that were lost, shape `(lost,)`. `lines_um` are sines in the readings, which make the band, shape
    `(n,)`, none where it is no line. `quantum_um` is the last digit of the sensor, the largest of all
    runs, 0 for none; `jitter_um` what the jitter of the instants of sampling makes in the readings; `band` the
    strongest narrow band of all runs.
    """

    noise: tuple[Noise, ...]
    source: str
    spikes: tuple[np.ndarray, ...]
    heights_um: tuple[np.ndarray, ...]
    repeats_um: np.ndarray
    quantum_um: float
    jitter_s: float
    jitter_um: float
    jitter_z: float
    band: Band
    lines_um: tuple[np.ndarray, ...] = ()

    def is_rounded(self, thresholds: Thresholds) -> bool:
        """Whether rounding is more than a minor part of the noise."""
        return self.quantum_um**2 / 12 > thresholds.minor_share * float(np.mean([n.total_um**2 for n in self.noise]))

    @property
    def count(self) -> int:
        """Number of spikes."""
        return sum(int(s.sum()) for s in self.spikes)

    @property
    def repaired(self) -> bool:
        """Whether there are lines, or enough spikes, to be taken out."""
        return self.count >= _FEWEST_SPIKES or bool(self.lines_um)

    @property
    def wrong_um(self) -> tuple[np.ndarray, ...]:
        """How far off the readings of each run are by spikes and lines, shape `(n,)`."""
        return tuple(map(np.add, self.heights_um, self.lines_um)) if self.lines_um else self.heights_um

    def beside(self, others: "Faults") -> "Faults":
        """The same with the spikes and lines of others, without which these were found."""
        spikes = tuple(map(np.logical_or, self.spikes, others.spikes))
        both = replace(self, spikes=spikes, heights_um=tuple(map(np.add, self.heights_um, others.heights_um)))
        if not others.lines_um:
            return both
        lines = tuple(map(np.add, self.lines_um, others.lines_um)) if self.lines_um else others.lines_um
        return replace(both, lines_um=lines, band=max(self.band, others.band, key=lambda band: band.size_um))

    def is_narrow(self, thresholds: Thresholds) -> bool:
        """Whether there is a narrow band beyond chance that is no hum."""
        band = self.band
        return band.z > thresholds.strong_z and band.narrow and not band.mains and not band.played

    def makes_noise(self, thresholds: Thresholds) -> bool:
        """Whether such a band is a part of the noise that counts."""
        least_um2 = thresholds.minor_share / 3 * float(np.mean([n.total_um**2 for n in self.noise]))
        # Up to its own size rounding makes lines, too, where a motion is even.
        return self.is_narrow(thresholds) and self.band.size_um**2 > max(least_um2, self.quantum_um**2 / 12)

    def rings_itself(self, resonance_Hz: float | None, thresholds: Thresholds) -> bool:
        """Whether the band is at the stage's resonance, which rings after all that a model lacks."""
        if resonance_Hz is None or self.band.quality == 0:
            return False
        width_Hz = self.band.frequency_Hz / self.band.quality
        return abs(self.band.frequency_Hz - resonance_Hz) < thresholds.apart_z * width_Hz

    def clean(self, records: Sequence[Record]) -> list[Record]:
        """Take the spikes and lines out of records."""
        if not self.repaired:
            return list(records)
        return [
            replace(record, displacement_um=np.asarray(record.displacement_um) - wrong_um)
            for record, wrong_um in zip(records, self.wrong_um, strict=True)
        ]


def find_faults(
    regression: Regression,
    change_um: Sequence[np.ndarray] | None = None,
    thresholds: Thresholds = THRESHOLDS,
    roughness: Sequence[float] = (),
) -> Faults:
    """Look at what a fitted plain stage leaves of each run, sample by sample, its density being so rough.

    Where effects are known, `change_um` is what they change in each run, shape `(n,)`, and is taken off before.
    """
    if change_um is not None:
        rest = tuple(r - change for r, change in zip(regression.residuals, change_um, strict=True))
        regression = replace(regression, residuals=rest)
    baseline = regression.baseline
    used = (left[mask] for left, mask in zip(regression.residuals, regression.masks, strict=True))
    guess = [white_noise(max(rough_noise_um(left), 1e-9 * baseline.stroke_um)) for left in used]
    projector = Projector(regression, guess, roughness)
    followed = projector.follow(projector.residual)
    quantum = max(quantum_um(run.displacement_um) for run in baseline.runs)
    # Rounding is noise that a command at rest does not show.
    least = quantum / 12**0.5
    floors, found, heights, repeats, jitters, shaken, fast, positions = [], [], [], [], [], [], [], []
    poles = np.asarray(baseline.stage.poles_rad_per_s).real if baseline.dynamic else np.zeros(0)
    # After so many e-folds a motion has settled.
    settling_s = float(8.0 / max(np.min(np.abs(poles)), 1e-3)) if len(poles) else 0.0
    fitted = zip(baseline.runs, followed, regression.nuisance, regression.residuals, strict=True)
    for run, follow, nuisance, residual in fitted:
        moved = residual - follow
        mask = run.fitted
        left = moved - nuisance @ np.linalg.lstsq(nuisance[mask], moved[mask], rcond=None)[0]
        # What was written for lost samples is no reading.
        left, residual = _between(left, run.record.lost), _between(residual, run.record.lost)
        bad = spikes(run.record.voltage_V, left, 2 * quantum, thresholds.spike_z)
        # A stage that would have to move far leaves spikes of its own, to first order, where the readings have none.
        alone = left - _between(left, bad)
        bad &= (residual - _between(residual, bad)) * alone > _SEEN * alone**2
        smooth = _between(left, bad)
        found.append(bad)
        heights.append(left - smooth)
        repeats.append(_repeats_um(run.record))
        fast.append(smooth)
        positions.append(run.displacement_um - left)
    fast = _without_cycles(fast, positions, [run.fitted for run in baseline.runs], thresholds)
    for run, smooth, position in zip(baseline.runs, fast, positions, strict=True):
        voltage_V, mask = run.record.voltage_V, run.fitted
        settings = settling_s, 1e-9 * float(np.ptp(run.displacement_um)), thresholds.apart_z, thresholds.minor_share
        floors.append(floor_of(voltage_V, smooth, mask, run.rate_Hz, *settings))
        # Differences of a few samples in a period are less than its slope.
        rate = scipy.interpolate.CubicSpline(run.record.time_s, position)(run.record.time_s, 1)
        size, z, most = jitter_s(smooth[mask], rate[mask], least, thresholds.apart_z)
        jitters.append((z, size, np.abs(rate), most))
        interval_s = float(np.median(np.diff(run.record.time_s)))
        shaken.append((smooth[mask], interval_s, voltage_V[mask]))
    floors = pooled(floors, thresholds.apart_z)
    noise = [one.noise if one.noise.total_um > least else white_noise(least) for one in floors]
    z, size, _, _ = max(jitters, key=lambda j: j[0])
    # One recorder took all runs: what only one of them shows is something else.
    z = z if size / 2 < min(most for _, _, _, most in jitters) else 0.0
    if z > thresholds.strong_z:
        noise = [
            replace(n, spread=np.sqrt(1 + (size * rate / n.innovation_um) ** 2))
            for n, (_, _, rate, _) in zip(noise, jitters, strict=True)
        ]
    band = _one_floor(_bands(shaken, thresholds), thresholds)
    source = "idle stretches where there are any, and the fastest changes of the residual elsewhere"
    if all(floor.idle for floor in floors):
        source = "idle stretches of the runs"
    elif not any(floor.idle for floor in floors):
        source = "the fastest changes of the residual"
    if any(len(floor.noise.past) for floor in floors if not floor.idle):
        source += ", of which neighbours are correlated"
    elif not all(floor.idle for floor in floors):
        source += ", as if it were white"
    size = size if z > thresholds.strong_z else 0.0
    band, lines = _with_lines(band, fast, [run.fitted for run in baseline.runs], shaken, thresholds)
    made = size * float(np.sqrt(np.mean(np.concatenate([rate for _, _, rate, _ in jitters]) ** 2)))
    return Faults(
        *(tuple(noise), source, tuple(found), tuple(heights), np.concatenate(repeats), quantum, size, made, z),
        *(band, lines),
    )


def _with_lines(
    band: Band,
    left_um: Sequence[np.ndarray],
    used: Sequence[np.ndarray],
    shaken: Sequence[tuple[np.ndarray, float, np.ndarray]],
    thresholds: Thresholds,
) -> tuple[Band, tuple[np.ndarray, ...]]:
    """A band, and the sines in what is left of the runs that make it, shape `(n,)`; none unless all runs have one."""
    if not (band.z > thresholds.strong_z and band.is_line and not band.mains and not band.played and not band.alone):
        return band, ()
    each = [line_in(left, one[1], own, band) for left, own, one in zip(left_um, used, shaken, strict=True)]
    found = [one for one in each if one is not None]
    if len(found) < len(each):
        return band, ()
    lines = tuple(line for _, line in found)
    middle_Hz = float(np.mean([frequency_Hz for frequency_Hz, _ in found]))
    size_um = float(np.sqrt(np.mean([np.mean(line**2) for line in lines])))
    rest_um = [float(np.std((left - line)[own])) for left, own, line in zip(left_um, used, lines, strict=True)]
    samples = sum(int(own.sum()) for own in used)
    return replace(band, frequency_Hz=middle_Hz, size_um=size_um, sd_um=max(rest_um) / samples**0.5), lines


def _repeats_um(record: Record) -> np.ndarray:
    """How far off the readings of lost samples were, which were those of the last one before that was not lost."""
    lost = np.flatnonzero(record.lost)
    reading = np.asarray(record.displacement_um)
    before = np.maximum.accumulate(np.where(record.lost, 0, np.arange(len(record))))[lost]
    return reading[before] - reading[lost]


def _one_floor(bands: list[Band], thresholds: Thresholds) -> Band:
    """The strongest band that may be the floor's, which shakes all runs.

    What may be hum, or played, in one run may be told from that in another.
    """
    seen = []
    for k, one in enumerate(bands):
        others = [b for j, b in enumerate(bands) if j != k and not b.played and b.z > thresholds.chance_z]
        seen.append(replace(one, played=one.played and not any(one.agrees(other) for other in others)))
    strong_z = thresholds.strong_z
    return max(seen, key=lambda one: (not one.mains and not one.played, one.z > strong_z and not one.alone, one.z))


def _bands(residuals: list[tuple[np.ndarray, float, np.ndarray]], thresholds: Thresholds) -> list[Band]:
    """The band of each residual, given with its sampling interval and its command, and whether it is there alone."""
    found, chance = [], float(scipy.stats.norm.sf(thresholds.worse_z))
    for k, residual in enumerate(residuals):
        band, others = band_of(*residual), residuals[:k] + residuals[k + 1 :]
        alone = band.z > thresholds.strong_z and not all(may_hold(band, *one[:2], chance) for one in others)
        found.append(replace(band, alone=alone))
    return found


def _between(values: np.ndarray, bad: np.ndarray) -> np.ndarray:
    """Values with those of bad samples on lines between their neighbours, shape `(n,)`."""
    return np.interp(np.arange(len(values)), np.flatnonzero(~bad), values[~bad])


def _without_cycles(
    left_um: list[np.ndarray], positions_um: list[np.ndarray], used: list[np.ndarray], thresholds: Thresholds
) -> list[np.ndarray]:
    """Take off what repeats itself with the position, where most of the fastest changes are that, and no noise."""
    each = list(zip(left_um, positions_um, used, strict=True))
    noise_um = np.array([max(rough_noise_um(left[mask]), 1e-300) for left, _, mask in each])
    scaled = [left[mask] / noise for (left, _, mask), noise in zip(each, noise_um, strict=True)]
    found = cycles(scaled, [position[mask] for _, position, mask in each])
    if found.z <= thresholds.cycles:
        return left_um
    rest = [without_cycles(left, position, found.period_um, mask) for left, position, mask in each]
    less_um = np.array([rough_noise_um(left[mask]) for left, mask in zip(rest, used, strict=True)])
    return rest if np.any(less_um**2 < (1 - thresholds.explained_share) * noise_um**2) else left_um


@dataclass(frozen=True)
class Fault:
    """A fault of samples or noise that is a cause of its own, and its parameters with standard deviations."""

    statistic: Statistic
    z: float
    parameters: tuple[tuple[str, float, float, str], ...]
    variance_um2: float


def name_faults(
    faults: Faults, cyclic: bool, mistaken: bool = False, thresholds: Thresholds = THRESHOLDS
) -> list[Fault]:
    """Which of them explain enough of what is left.

    What repeats itself with the position (`cyclic`) is no jitter, and at an even speed it looks like a narrow band.
    A band may be `mistaken`: the stage rings in bursts, or at its resonance, and a floor shakes all the time.
    """
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
    if len(again_um := faults.repeats_um):
        share, square_um2 = len(again_um) / samples, float(np.mean(again_um**2))
        z = float(np.max(np.abs(again_um)) / total**0.5)
        lost = "fraction", share, len(again_um) ** 0.5 / samples, "1"
        found.append(Fault("repeats", z, (lost,), share * square_um2))
    step = faults.quantum_um
    if step**2 / 12 > thresholds.minor_share * total:
        z = (samples * step**2 / 12 / total) ** 0.5
        found.append(Fault("rounding", z, (("step_um", step, 1e-6 * step, "um"),), step**2 / 12))
    if faults.jitter_s > 0 and not cyclic:
        jitter = "jitter_s", faults.jitter_s, faults.jitter_s / (2 * max(faults.jitter_z, 1e-9)), "s"
        found.append(Fault("jitter", faults.jitter_z, (jitter,), faults.jitter_um**2))
    band = faults.band
    if faults.makes_noise(thresholds) and not cyclic and not mistaken:
        middle = "frequency_Hz", band.frequency_Hz, band.frequency_Hz / band.quality, "Hz"
        size_of_band = "amplitude_um", band.size_um, band.sd_um, "um"
        found.append(Fault("band", band.z, (size_of_band, middle), band.size_um**2))
    return found
