"""Noise by frequency and by averaging time: bands, lines such as mains hum, resonances, and the Allan deviation."""

from dataclasses import dataclass

import numpy as np
import scipy

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
    window = scipy.signal.windows.blackmanharris(n, sym=False)
    # Mean squares of the sines that make up the record, so that a line's bins add up to half its amplitude squared.
    power = 2 * np.abs(scipy.fft.rfft(window * residual_um)) ** 2 / (n * np.sum(window**2))
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
