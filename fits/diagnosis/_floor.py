"""Noise floors, and faults of single samples: what is asked of the data before any physics."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import median_filter, rank_filter, uniform_filter1d

from fits.loop._run import Run
from fits.stats._at_rest import idle_stretches
from fits.stats._whiten import Noise, learn_noise, rough_noise_um

# So many idle samples are a floor.
_IDLE = 150
# Lag-one correlation of idle noise, in standard deviations, above which it counts as coloured.
_COLOURED = 4.0
# Standard deviations by which noise of runs may differ that is the same.
_ALIKE = 4.0
# Mains, and by how much they drift; lines are looked for in stretches of so many samples, and count where no more
# than this part of the variance is left without them.
MAINS_Hz, _DRIFT = (50.0, 60.0), 0.002
_LONG, _MOSTLY = 60, 0.7
# Lines drift out of step with their frequency after so many s.
_STEADY_s = 1.5
# A narrow band lies within this part of its frequency on either side.
_WIDE = 0.2
# Bins that a band may have, the room that it needs in bins of its width, how many times more evidence a broad one
# must have, and the share of the mean power that nearly every eighth of a record has. No line has so many bins.
_BROAD = 16
_WIDTHS, _ROOM, _MORE, _WEAKEST = (1, 4, 16, 64), 12, 3.0, 0.25
# A sample is a spike beyond this many standard deviations, where at most so many stand together and the others up to
# so far away are much smaller.
SPIKE, _TOGETHER, _ALONE = 7.0, 3, 16
# A command that moves, or turns, by more than these parts of its range at one of some samples may cause what looks
# like a spike.
_EDGE, _TURN, _NEAR = 0.02, 0.004, 6
# Jitter beside rounding has at least so many times its variance.
_ROUNDING = 10.0
# Standard deviations beyond which the variance that a jitter makes is not.
_SURE = 4.0
# It is one all the same beyond such a multiple of what nearly all of these samples are off by.
_MOSTLY_NEAR, _BEYOND = 0.98, 4.0


@dataclass(frozen=True)
class Floor:
    """What a run's noise is, whatever a model leaves.

    Attributes
    ----------
    noise
        Its standard deviation and colour.
    idle
        How many idle samples it was read off; 0 where it was read off the residual.
    """

    noise: Noise
    idle: int


def floor_of(run: Run, residual_um: np.ndarray, settling_s: float) -> Floor:
    """Read the noise of a run off its idle stretches, or off the fastest changes of the residual.

    A stretch is idle once the stage has settled, which takes it `settling_s`.
    """
    pieces = []
    for stretch in idle_stretches(run.record.voltage_V, round(settling_s * run.rate_Hz)):
        piece = residual_um[stretch]
        time = np.linspace(-1, 1, len(piece))
        order = min(3, len(piece) // 12)
        # What settles is no noise.
        pieces.append(piece - np.polyval(np.polyfit(time, piece, order), time))
    count = sum(len(piece) for piece in pieces)
    if count >= _IDLE:
        pieces = _without_mains(pieces, 1 / run.rate_Hz)
        count = sum(len(piece) for piece in pieces)
        joined = np.concatenate(pieces)
        joined = (
            joined[np.abs(joined) < 8 * rough_noise_um(joined) + 1e-300] if rough_noise_um(joined) > 0 else joined
        )
        freedom = 4.0 * len(pieces)
        level = float(np.std(joined)) * (len(joined) / max(len(joined) - freedom, 1)) ** 0.5
        correlation = float(np.mean(joined[1:] * joined[:-1]) / max(np.mean(joined**2), 1e-300))
        if abs(correlation) * len(joined) ** 0.5 > _COLOURED and level > 0:
            return Floor(learn_noise(joined, freedom), len(joined))
        if level > 0:
            return Floor(Noise(level, np.zeros(0)), len(joined))
    used = residual_um[run.fitted]
    return Floor(Noise(max(rough_noise_um(used), 1e-9 * float(np.ptp(run.displacement_um))), np.zeros(0)), 0)


def pooled(floors: Sequence[Floor]) -> list[Floor]:
    """Floors of one sensor: white noise that was read off idle stretches, and is the same in all runs by chance."""
    white = [floor for floor in floors if floor.idle and len(floor.noise.past) == 0]
    if len(white) < 2:
        return list(floors)
    counts = np.array([floor.idle for floor in white])
    levels = np.array([floor.noise.innovation_um for floor in white])
    level = float(np.sqrt(np.average(levels**2, weights=counts)))
    if np.any(np.abs(levels / level - 1) > _ALIKE / np.sqrt(2 * counts)):
        return list(floors)
    return [
        replace(one, noise=Noise(level, np.zeros(0))) if any(one is other for other in white) else one
        for one in floors
    ]


def _without_mains(pieces: list[np.ndarray], interval_s: float) -> list[np.ndarray]:
    """Take the lines of mains out of stretches, where they are most of what is there: hum is a cause, not noise."""
    most = max(round(_STEADY_s / interval_s), _LONG)
    long = [
        part for piece in pieces if len(piece) >= _LONG for part in np.array_split(piece, max(len(piece) // most, 1))
    ]
    if sum(len(piece) for piece in long) < _IDLE:
        return pieces
    before = sum(float(piece @ piece) for piece in long)
    best, found = _MOSTLY * before, pieces
    for mains in MAINS_Hz:
        for frequency in mains * (1 + np.linspace(-_DRIFT, _DRIFT, 9)):
            left = []
            for piece in long:
                phase = 2 * np.pi * frequency * interval_s * np.arange(len(piece))
                lines = np.stack([wave(h * phase) for h in (1, 2, 3) for wave in (np.cos, np.sin)], axis=1)
                left.append(piece - lines @ np.linalg.lstsq(lines, piece, rcond=None)[0])
            rest = sum(float(piece @ piece) for piece in left)
            if rest < best:
                best, found = rest, left
    return found


def spikes(run: Run, residual_um: np.ndarray, least_um: float = 0.0) -> np.ndarray:
    """Samples that stand alone, far off their neighbours, where the command gives no reason; shape `(n,)`."""
    off = residual_um - median_filter(residual_um, 7, mode="nearest")
    spread = 1.4826 * median_filter(np.abs(off), 101, mode="nearest")
    spread = np.maximum(spread, 1.4826 * float(np.median(np.abs(off))))
    far = np.abs(off) > np.maximum(SPIKE * spread, least_um + 1e-300)
    # What rings has neighbours as large; what is alone has none, or one of its kind by chance.
    size = np.abs(off)
    # In two dimensions: in one, SciPy 1.17 takes a footprint with a gap for one without.
    beside = np.abs(np.arange(-_ALONE, _ALONE + 1))[None] > _TOGETHER
    far &= size > 3 * rank_filter(size[None], -2, footprint=beside, mode="nearest")[0]
    voltage = run.record.voltage_V
    change = np.diff(voltage, prepend=voltage[0])
    turned = np.abs(np.diff(change, append=change[-1])) > _TURN * float(np.ptp(voltage))
    moved = (np.abs(change) > _EDGE * float(np.ptp(voltage))) | turned
    near = np.convolve(moved, np.ones(2 * _NEAR + 1), mode="same") > 0.5
    # Where it may, others do so, too.
    usual = float(np.quantile(size[near], _MOSTLY_NEAR)) if near.any() else 0.0
    far &= ~near | (size > _BEYOND * usual)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], far.astype(int), [0]])))
    for first, stop in zip(edges[::2], edges[1::2], strict=True):
        if stop - first > _TOGETHER:
            far[first:stop] = False
    return far


def jitter_s(residual_um: np.ndarray, rate_um_per_s: np.ndarray, least_um: float = 0.0) -> tuple[float, float, float]:
    """Jitter of the instants of sampling, its evidence in standard deviations, and the most that it may be.

    Noise that grows with the speed, from sample to sample: the variance of the residual about its neighbours is
    compared with the square of the speed.
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
    most = float((max(more + _SURE * error, 0.0) / faster) ** 0.5)
    # Rounding is less where nothing moves, and there its median is not that of normal noise.
    if more <= _ROUNDING * least_um**2:
        return 0.0, 0.0, most
    return float((more / faster) ** 0.5), float(more / error), most


@dataclass(frozen=True)
class Band:
    """The strongest narrow band of a residual: middle, size (rms) and its sd, quality, evidence, and bins."""

    frequency_Hz: float
    size_um: float
    sd_um: float
    quality: float
    z: float
    rate_Hz: float = 0.0
    bins: int = 1

    @property
    def mains(self) -> bool:
        """Whether it is near a line of mains, or near what sampling makes of one, or is nothing at all."""
        rate, own = self.rate_Hz, _DRIFT * 4
        if self.bins >= _BROAD:
            return False
        return rate == 0 or any(
            abs(self.frequency_Hz - abs((k * line + rate / 2) % rate - rate / 2))
            < own * k * line + self.frequency_Hz / 60
            for line in MAINS_Hz
            for k in range(1, 5)
        )


def band_of(residual_um: np.ndarray, interval_s: float, command_V: np.ndarray) -> Band:
    """Find a narrow band between 2 and 200 Hz that goes on throughout and that the command does not play.

    Bins of the spectrum are compared with the median of those around; a band of noise has the chance of so many
    exponential variables.
    """
    none = Band(0.0, 0.0, 0.0, 0.0, 0.0)
    n = len(residual_um)
    window = np.hanning(n)
    frequency = np.fft.rfftfreq(n, interval_s)

    def spectrum(values: np.ndarray) -> np.ndarray:
        return np.abs(np.fft.rfft((values - values.mean()) * window)) ** 2 / np.sum(window**2)

    power, played = spectrum(residual_um), spectrum(command_V)
    inside = (frequency > max(2.0, 5 * frequency[1])) & (frequency < min(200.0, 0.45 / interval_s))
    if inside.sum() < 20:
        return none
    best, wide, chance, around = _strongest(power, inside)
    # A loop played again and again has lines at multiples of its frequency.
    lines = median_filter(played, 2 * (len(power) // 16) + 1, mode="nearest")
    for k in range(1, 13):
        at = round(best / k)
        near = slice(max(at - 2, 1), at + 3)
        if at > 2 and played[near].max() > max(1e3 * lines[at], 1e-4 * played.sum()):
            return none
    # It goes on throughout: no block has nearly all of it.
    swing = np.exp(-2j * np.pi * frequency[best] * interval_s * np.arange(n)) * (residual_um - residual_um.mean())
    blocks = np.array([np.abs(block.sum()) ** 2 for block in np.array_split(swing, 8)])
    if np.sort(blocks)[-2:].sum() > 0.85 * blocks.sum():
        return none
    if wide > 1 and not _steady(residual_um, best / n, 2 * wide / n):
        return none
    low = np.searchsorted(frequency, frequency[best] * (1 - _WIDE))
    high = max(np.searchsorted(frequency, frequency[best] * (1 + _WIDE)), best + 4)
    above = power[low:high] - around[low:high]
    excess = max(float(above.sum()), 0.0) * 2 / n
    # As wide as a rectangle of the same height and area.
    peak = np.convolve(above, np.ones(5) / 5, mode="same").max()
    width = max(float(above.sum() / peak), 1.0) * frequency[1]
    # Noise of this width has so many independent values.
    sd = excess**0.5 / (2 * max(width * n * interval_s, 1.0) ** 0.5)
    return Band(
        float(frequency[best]),
        excess**0.5,
        sd,
        float(frequency[best] / width),
        max(-2 * chance, 0.0) ** 0.5,
        1 / interval_s,
        wide,
    )


def _strongest(power: np.ndarray, inside: np.ndarray) -> tuple[int, int, float, np.ndarray]:
    """Bin of the strongest band, its width in bins, log-probability of as much by chance, and what is around.

    One bin, or the mean of some where that is more by far: one of noise may be low in the very middle of a band.
    """
    found = []
    for wide in _WIDTHS:
        if _ROOM * wide > inside.sum():
            break
        reach = max(len(power) // 16, _ROOM * wide // 2)
        around = np.maximum(median_filter(power, 2 * reach + 1, mode="reflect") / 0.693, 1e-300)
        ratio = np.where(inside, uniform_filter1d(power, wide), 0.0) / around
        best = int(np.argmax(ratio))
        # Chernoff's bound of the mean of exponential variables, of which the window leaves half; exact for one.
        high = max(float(ratio[best]), 1.0)
        above = high if wide == 1 else wide / 2 * (high - 1 - np.log(high))
        found.append((best, wide, float(np.log(inside.sum() / wide)) - above, around))
    narrow, broad = found[0], min(found, key=lambda one: one[2])
    return broad if broad[2] < _MORE * min(narrow[2], -1.0) else narrow


def _steady(values: np.ndarray, middle: float, width: float) -> bool:
    """Whether what is in a band, in parts of the sampling rate, is as strong throughout as noise of that width."""
    spectrum = np.fft.rfft(values - values.mean())
    frequency = np.fft.rfftfreq(len(values))
    part = np.fft.irfft(np.where(np.abs(frequency - middle) < width / 2, spectrum, 0.0), len(values))
    blocks = np.sort([float(block @ block) for block in np.array_split(part, 8)])
    return bool(blocks[1] > _WEAKEST * blocks.mean())
