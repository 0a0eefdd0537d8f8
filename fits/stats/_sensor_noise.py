"""What the noise of a sensor is in one run, and which of its samples are bad, whatever model leaves the residual."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from fits.stats._colour import Spectrum, coloured
from fits.stats._noise import Noise, idle_stretches, learn_noise, rough_noise_um, stretches
from fits.stats._noise_spectrum import DRIFT, MAINS_Hz

# So many samples at rest are enough to read the noise from.
_IDLE = 150
# Lines of mains are looked for in stretches of at least so many samples, and no longer than stay in step, in s.
_LONG, _STEADY_s = 60, 1.5
# At most so many spikes stand together, and the other samples up to so far away are much smaller.
_MOST_TOGETHER, _COMPARED_SAMPLES = 3, 16
# A command that moves, or turns, by more than these parts of its range within so many samples may cause what looks
# like a spike.
_MOVED_SHARE, _TURNED_SHARE, _SAMPLES_AROUND = 0.02, 0.004, 6
# There a spike is larger than this multiple of what is usual, unless there are so many elsewhere that they are seen
# to be as many there, within so many standard deviations.
_OUTLYING, _FEWEST_ELSEWHERE, _CHANCE_Z = 2.0, 4, 3.0
# Median of the negative product of neighbouring bends of white noise of variance 1, by simulation.
_OPPOSED = 0.3726
# Jitter beside rounding has at least so many times its variance.
_ROUNDING = 10.0


@dataclass(frozen=True)
class Floor:
    """What a run's noise is, whatever a model leaves, and how many `idle` samples it was read off; 0 for none.

    Of none it is white, and `fast` is the spectrum of the fastest changes, which shows whether it is.
    """

    noise: Noise
    idle: int
    fast: Spectrum | None = None


def floor_of(
    voltage_V: np.ndarray,
    residual_um: np.ndarray,
    used: np.ndarray,
    rate_Hz: float,
    settling_s: float,
    least_um: float,
    same_z: float,
    hum_share: float,
) -> Floor:
    """Read the noise of a run off its idle stretches, or off the fastest changes of the residual where it is `used`.

    A stretch is idle once the stage has settled, which takes it `settling_s`. Neighbours that agree by less than
    `same_z` standard deviations do so by chance, and hum is at least `hum_share` of the variance. Where nothing is
    idle, the noise is `least_um` at least.
    """
    pieces = []
    for stretch in idle_stretches(voltage_V, round(settling_s * rate_Hz)):
        piece = residual_um[stretch]
        time = np.linspace(-1, 1, len(piece))
        # What settles is no noise.
        pieces.append(piece - np.polyval(np.polyfit(time, piece, min(3, len(piece) // 12)), time))
    if sum(len(piece) for piece in pieces) >= _IDLE:
        pieces = _without_mains(pieces, 1 / rate_Hz, 1 - hum_share)
        joined = np.concatenate(pieces)
        usual = np.abs(joined) < 8 * rough_noise_um(joined)
        # Readings that keep to one digit for long have no rough noise, and most of them are no outliers.
        joined = joined[usual] if usual.sum() > len(usual) / 2 else joined
        freedom = 4.0 * len(pieces)
        level = float(np.std(joined)) * (len(joined) / max(len(joined) - freedom, 1)) ** 0.5
        correlation = float(np.mean(joined[1:] * joined[:-1]) / max(np.mean(joined**2), 1e-300))
        if level > 0:
            correlated = abs(correlation) * len(joined) ** 0.5 > same_z
            return Floor(learn_noise(joined, freedom) if correlated else white_noise(level), len(joined))
    left_um = residual_um[used]
    # Noise that alternates from sample to sample is no larger than all that is left.
    level = min(rough_noise_um(left_um), float(np.std(left_um)))
    return Floor(white_noise(max(level, least_um)), 0, Spectrum.of(left_um))


def white_noise(level_um: float) -> Noise:
    """Noise without colour."""
    return Noise(level_um, np.zeros(0))


def pooled(floors: Sequence[Floor], same_z: float) -> list[Floor]:
    """Floors of one sensor: what they agree on, within so many standard deviations, is the same in all runs.

    That is the level of white noise that was read off idle stretches, and the colour of noise that was not.
    """
    colours = coloured([floor.fast for floor in floors], same_z)
    floors = [one if c is None else replace(one, noise=c) for one, c in zip(floors, colours, strict=True)]
    white = [floor.idle > 0 and len(floor.noise.past) == 0 for floor in floors]
    if sum(white) < 2:
        return floors
    counts = np.array([floor.idle for floor in floors])[white]
    levels = np.array([floor.noise.innovation_um for floor in floors])[white]
    level = float(np.sqrt(np.average(levels**2, weights=counts)))
    if np.any(np.abs(levels / level - 1) > same_z / np.sqrt(2 * counts)):
        return floors
    return [replace(one, noise=white_noise(level)) if own else one for one, own in zip(floors, white, strict=True)]


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


def spikes(voltage_V: np.ndarray, residual_um: np.ndarray, least_um: float, spike_z: float) -> np.ndarray:
    """Samples that stand alone, far off their neighbours, where the command gives no reason; shape `(n,)`.

    They are off by `least_um` and `spike_z` standard deviations at least.
    """
    size = np.abs(residual_um - scipy.ndimage.median_filter(residual_um, 7, mode="nearest"))
    spread = np.maximum(
        1.4826 * scipy.ndimage.median_filter(size, 101, mode="nearest"), 1.4826 * float(np.median(size))
    )
    far = size > np.maximum(spike_z * spread, least_um + 1e-300)
    # What rings has neighbours as large; what is alone has none, or one of its kind by chance.
    # In two dimensions: in one, SciPy 1.17 takes a footprint with a gap for one without.
    beside = np.abs(np.arange(-_COMPARED_SAMPLES, _COMPARED_SAMPLES + 1))[None] > _MOST_TOGETHER
    far &= size > 3 * scipy.ndimage.rank_filter(size[None], -2, footprint=beside, mode="nearest")[0]
    change = np.diff(voltage_V, prepend=voltage_V[0])
    turned = np.abs(np.diff(change, append=change[-1])) > _TURNED_SHARE * float(np.ptp(voltage_V))
    moved = (np.abs(change) > _MOVED_SHARE * float(np.ptp(voltage_V))) | turned
    width = 2 * _SAMPLES_AROUND + 1
    near = np.convolve(moved, np.ones(width), mode="same") > 0.5
    # Where it may, others do so, too: one sample in fifty, and one in a tenth of the places. What comes no more often
    # there than elsewhere it does not cause.
    places = [slice(k, min(k + width, stop)) for first, stop in stretches(near) for k in range(first, stop, width)]
    if places and _is_more_often(far, near):
        usual = _OUTLYING * float(np.quantile(size[near], 0.98))
        usual = max(usual, float(np.quantile([size[place].max() for place in places], 0.9)))
        far &= ~near | (size > _OUTLYING * usual)
    for first, stop in stretches(far):
        if stop - first > _MOST_TOGETHER:
            far[first:stop] = False
    return far


def _is_more_often(marked: np.ndarray, there: np.ndarray) -> bool:
    """Whether samples are marked more often there than elsewhere, or so seldom elsewhere that nothing is known."""
    others, count = int(np.sum(marked & ~there)), int(np.sum(marked & there))
    expected = others / max(np.sum(~there), 1) * float(np.sum(there))
    if others < _FEWEST_ELSEWHERE:
        return True
    # Either number is Poisson's.
    return bool(count > expected + _CHANCE_Z * (expected + expected**2 / others) ** 0.5)


def jitter_s(
    residual_um: np.ndarray, rate_um_per_s: np.ndarray, least_um: float, apart_z: float
) -> tuple[float, float, float]:
    """Jitter of the instants of sampling, its evidence in standard deviations, and the most that it may be.

    It is noise that grows with the speed: the variance about the neighbours is compared with the square of the speed.
    """
    bent = residual_um[1:-1] - (residual_um[2:] + residual_um[:-2]) / 2
    square = bent**2 / 1.5
    # So do the instants of all three.
    speed = (rate_um_per_s[1:-1] ** 2 + (rate_um_per_s[2:] ** 2 + rate_um_per_s[:-2] ** 2) / 4) / 1.5
    order = np.argsort(speed[:-1])
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
    # Noise of neighbours is independent, so that one bends as the other does not; what is no noise bends alike.
    opposed = -bent[:-1] * bent[1:]
    if float(np.median(opposed[quick]) - np.median(opposed[slow])) / _OPPOSED < more / 2:
        return 0.0, 0.0, most
    return float((more / faster) ** 0.5), float(more / error), most
