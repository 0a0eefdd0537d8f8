"""Noise by frequency and by averaging time: bands, lines such as mains hum, resonances, and the Allan deviation."""

from dataclasses import dataclass

import numpy as np
from scipy import fft, signal
from scipy.ndimage import median_filter, uniform_filter1d

from fits.io._quantity import FloatArray

# A Blackman-Harris window spreads a line over this many bins to either side, and nothing above -92 dB beyond.
_LOBE = 4
# Bins this far apart are independent to 2 % under that window.
_STRIDE = 3
# Most neighbours on either side that the floor is taken from: enough to tell it, and narrow enough for a resonance
# of some 50 bins to pass as floor.
_SIDE = 12
# Mains, and the part by which they drift.
MAINS_Hz, DRIFT = (50.0, 60.0), 0.002
# A narrow band lies within this part of its frequency on either side.
_WIDE = 0.2
# The room that a band needs, in bins of its width.
_ROOM = 12


@dataclass(frozen=True)
class NoiseBand:
    """Standard deviation of the part of the noise between two frequencies, without mean and drift."""

    low_Hz: float
    high_Hz: float
    sd_um: float


@dataclass(frozen=True)
class NoiseLine:
    """A narrow line above the floor of the noise, centred at a frequency.

    The amplitude is that of the sine, half its peak-to-peak value; its standard deviation comes from the floor around
    it. `false_alarm` is the probability, at most, that noise without any line shows one as clear as this anywhere.
    """

    frequency_Hz: float
    amplitude_um: float
    amplitude_sd_um: float
    false_alarm: float


def find_lines(residual_um: FloatArray, rate_Hz: float, false_alarm: float = 0.01) -> tuple[NoiseLine, ...]:
    """Find sines in evenly sampled readings without mean and drift, by falling amplitude.

    Each bin of the spectrum is compared with the median of up to 24 neighbours, half of them on either side, beyond
    the reach of a line and within half the bin's frequency, so that the colour of the noise cancels. For noise, power
    over that median has a distribution in closed form whatever the level (H. Rohling, "Radar CFAR Thresholding in
    Clutter and Multiple Target Situations", IEEE Trans. Aerosp. Electron. Syst. 19 (1983), 608-621). Its tail times
    the number of bins looked at bounds the probability of any false line, which is `false_alarm`.

    What is narrower than about 50 / duration counts as a line, be it a sharp resonance. Lines within 4 / duration of
    each other are one, and one that completes fewer than 20 cycles in the record is not looked for.
    """
    n = len(residual_um)
    window = signal.windows.blackmanharris(n, sym=False)
    # Mean squares of the sines that make up the record, so that a line's bins add up to half its amplitude squared.
    power = 2 * np.abs(fft.rfft(window * residual_um)) ** 2 / (n * np.sum(window**2))
    chance, floor = _compare(power)
    lines = []
    for i in np.flatnonzero(chance < false_alarm):
        lobe = slice(i - _LOBE, i + _LOBE + 1)
        if power[lobe].max() > power[i]:
            continue
        above = power[lobe] - floor[i]
        weight = np.maximum(above, 0.0)
        centre = float(weight @ np.arange(lobe.start, lobe.stop) / weight.sum())
        # Half of the floor falls on the quadrature that changes the amplitude.
        sd = np.sqrt(floor[i] * n * np.sum(window**2)) / np.sum(window)
        amplitude = np.sqrt(2 * above.sum())
        lines.append(NoiseLine(centre * rate_Hz / n, float(amplitude), float(sd), float(chance[i])))
    return tuple(sorted(lines, key=lambda line: -line.amplitude_um))


def _compare(power: FloatArray) -> tuple[FloatArray, FloatArray]:
    """False-alarm probability of each bin's power as a line, and the mean of the floor around it; shapes `(k,)`."""
    bins = np.arange(len(power))
    # Near 0 Hz and half the rate a lobe meets its own mirror image.
    reach = np.minimum(bins // 2, len(power) - 1 - _LOBE - bins)
    sides = np.clip((reach - _LOBE - 1) // _STRIDE + 1, 0, _SIDE)
    sides[:20] = 0  # cycles within the record
    chance, floor = np.ones(len(power)), np.zeros(len(power))
    for side in range(1, _SIDE + 1):
        # The median of 2 * side powers is the side-th smallest; these many are left as each is passed.
        left = np.arange(2 * side, side, -1)
        offsets = _LOBE + 1 + _STRIDE * np.arange(side)
        offsets = np.concatenate([-offsets, offsets])
        members = np.flatnonzero(sides == side)
        for some in np.array_split(members, len(members) // (1 << 16) + 1):
            median = np.partition(power[some[:, None] + offsets], side - 1, axis=1)[:, side - 1]
            ratio = power[some] / np.maximum(median, np.finfo(float).tiny)
            chance[some] = np.exp(-np.sum(np.log1p(ratio[:, None] / left), axis=1))
            floor[some] = median / np.sum(1 / left)
    return np.minimum(1.0, chance * np.count_nonzero(sides)), floor


def noise_bands(residual_um: FloatArray, rate_Hz: float) -> tuple[NoiseBand, ...]:
    """Split by decades; the squares add up to the mean square, by Parseval's theorem."""
    n = len(residual_um)
    power = np.abs(np.fft.rfft(residual_um) / n) ** 2
    power[1 : (n + 1) // 2] *= 2  # all but 0 Hz and half the rate stand for two
    frequency_Hz = np.fft.rfftfreq(n, 1 / rate_Hz)
    nyquist_Hz = rate_Hz / 2
    decades = np.arange(np.floor(np.log10(rate_Hz / n)) + 1, np.ceil(np.log10(nyquist_Hz)))
    edges = [0.0, *(10.0**decades), nyquist_Hz]
    where = np.searchsorted(edges[1:-1], frequency_Hz, side="right")
    squares = np.bincount(where, power, len(edges) - 1)
    return tuple(
        NoiseBand(float(low), float(high), float(np.sqrt(square)))
        for low, high, square in zip(edges[:-1], edges[1:], squares, strict=True)
    )


def allan_deviation(readings_um: FloatArray, interval_s: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Overlapping Allan deviation, up to a third of the record, and its approximate standard error."""
    n = len(readings_um)
    sums = np.concatenate([[0.0], np.cumsum(readings_um - readings_um.mean())])
    lengths = np.unique(np.geomspace(1, n // 3, 60).astype(int))
    differences = (sums[2 * m :] - 2 * sums[m:-m] + sums[: -2 * m] for m in lengths)
    deviation = np.array([np.sqrt(np.mean(d**2) / 2) for d in differences]) / lengths
    return lengths * interval_s, deviation, deviation / np.sqrt(2 * (n / lengths - 1))


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
        if self.bins >= 16:  # no line has so many
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
    for wide in (1, 4, 16, 64):  # bins
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
    return broad if broad[2] < 3.0 * min(narrow[2], -1.0) else narrow


def _steady(values: np.ndarray, middle: float, width: float) -> bool:
    """Whether what is in a band, in parts of the sampling rate, is as strong throughout as noise of that width."""
    spectrum = np.fft.rfft(values - values.mean())
    frequency = np.fft.rfftfreq(len(values))
    part = np.fft.irfft(np.where(np.abs(frequency - middle) < width / 2, spectrum, 0.0), len(values))
    blocks = np.sort([float(block @ block) for block in np.array_split(part, 8)])
    return bool(blocks[1] > 0.25 * blocks.mean())  # as nearly every eighth of a record has
