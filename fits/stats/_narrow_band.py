"""The strongest narrow band in the spectrum of a residual."""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import median_filter, uniform_filter1d

# Mains, and the part by which they drift.
MAINS_Hz, DRIFT = (50.0, 60.0), 0.002
# A narrow band lies within this part of its frequency on either side.
_WIDE = 0.2
# Bins that a band may have.
_WIDTHS = (1, 4, 16, 64)
# No line has so many bins.
_BROAD = 16
# The room that a band needs, in bins of its width.
_ROOM = 12
# A broad band must have so many times the evidence of a narrow one.
_LEAST_GAIN = 3.0
# Nearly every eighth of a record has at least this share of the mean power.
_WEAKEST = 0.25


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
        rate, own = self.rate_Hz, DRIFT * 4
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

    Bins of the spectrum are compared with the median around: those of noise are exponential variables.
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
    middle_Hz, z = float(frequency[best]), max(-2 * chance, 0.0) ** 0.5
    return Band(middle_Hz, excess**0.5, sd, float(frequency[best] / width), z, 1 / interval_s, wide)


def _strongest(power: np.ndarray, inside: np.ndarray) -> tuple[int, int, float, np.ndarray]:
    """Bin of the strongest band, its width in bins, log-probability of as much by chance, and what is around.

    A band wider than a bin counts where its mean is stronger by far: noise may be low in the very middle of a band.
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
    return broad if broad[2] < _LEAST_GAIN * min(narrow[2], -1.0) else narrow


def _steady(values: np.ndarray, middle: float, width: float) -> bool:
    """Whether what is in a band, in parts of the sampling rate, is as strong throughout as noise of that width."""
    spectrum = np.fft.rfft(values - values.mean())
    frequency = np.fft.rfftfreq(len(values))
    part = np.fft.irfft(np.where(np.abs(frequency - middle) < width / 2, spectrum, 0.0), len(values))
    blocks = np.sort([float(block @ block) for block in np.array_split(part, 8)])
    return bool(blocks[1] > _WEAKEST * blocks.mean())
