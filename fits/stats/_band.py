"""A narrow band in noise of any colour, as a shaking floor makes it, by the likelihood of the spectrum."""

from dataclasses import dataclass

import numpy as np
from scipy import stats
from scipy.ndimage import median_filter
from scipy.optimize import minimize, minimize_scalar

from fits.io._quantity import FloatArray
from fits.stats._noise import repeated_square
from fits.stats._noise_spectrum import DRIFT, MAINS_Hz

# Where a band is looked for, in Hz, and from how many cycles in the record on.
_LOWEST_Hz, _HIGHEST_Hz, _CYCLES = 2.0, 1000.0, 5
# A band is told from what is around it in so many bins at least.
_FEWEST = 20
# Bins of the spectrum are averaged over this part of their frequency. A Hann window leaves half of them independent.
_TOGETHER, _INDEPENDENT = 1 / 150, 0.5
# The floor is known by its level at every so many octaves.
_OCTAVES = 2
# A band is one of a resonance from this quality on; what is broader may be the colour of the noise.
_NARROW = 3.0
# A Hann window makes a line so many bins wide.
_LINE = 4
# Bins of less than this part of the strongest one's power hold nothing but rounding.
_ROUNDING = float(np.finfo(float).eps) ** 2
# What moves with the rig and makes more than this part of a band is no vibration.
_SHARE = 0.5
# A level is looked for within so many e-folds.
_REACH = 30.0
# Qualities, and heights above the floor, from which the likelihood climbs.
_QUALITIES, _HEIGHTS = tuple(2.0**k for k in range(9)), tuple(4.0**k for k in range(8))


@dataclass(frozen=True)
class Band:
    """The strongest narrow band of a residual: middle, size (rms) and its sd, quality, evidence, and bins.

    A band is `played` if it is as narrow as a line and at a multiple of one of the command's, and `alone` if another
    residual would show it, too, and does not.
    """

    frequency_Hz: float
    size_um: float
    sd_um: float
    quality: float
    z: float
    rate_Hz: float = 0.0
    bins: int = 1
    played: bool = False
    alone: bool = False

    @property
    def narrow(self) -> bool:
        """Whether it is too narrow to be the colour of the noise."""
        return self.quality > _NARROW

    @property
    def mains(self) -> bool:
        """Whether it is near a line of mains, or near what sampling makes of one, or is nothing at all."""
        rate, own = self.rate_Hz, DRIFT * 2
        if self.bins >= 16:  # no line has so many
            return False
        return rate == 0 or any(
            abs(self.frequency_Hz - abs((k * line + rate / 2) % rate - rate / 2))
            < own * k * line + self.frequency_Hz / 60
            for line in MAINS_Hz
            for k in range(1, 5)
        )

    @property
    def is_line(self) -> bool:
        """Whether it is no wider than a line is in so long a record."""
        return self.rate_Hz > 0 and self.bins <= _LINE

    def agrees(self, other: "Band") -> bool:
        """Whether another is within the half of their widths."""
        halves_Hz = (one.frequency_Hz / max(one.quality, 1.0) / 2 for one in (self, other))
        return abs(self.frequency_Hz - other.frequency_Hz) < sum(halves_Hz)


def band_of(residual_um: FloatArray, interval_s: float, command_V: FloatArray) -> Band:
    """Find a narrow band between 2 and 1000 Hz that goes on throughout, and say whether the command may play it.

    Residual and command are evenly sampled, shape `(n,)`. Where the samples show too few frequencies of that range,
    nothing is found, with an evidence of 0.

    The spectrum is that of a floor, whose logarithm is straight over every two octaves, and of one Lorentzian
    peak above it. The evidence is what the peak adds to the likelihood (P. Whittle, "Estimation and information in
    stationary time series", Ark. Mat. 2 (1953), 423-434), less what chance adds at the best of all places.
    """
    none = Band(0.0, 0.0, 0.0, 0.0, 0.0)
    n, bin_Hz = len(residual_um), 1 / (len(residual_um) * interval_s)
    lowest_Hz, highest_Hz = max(_LOWEST_Hz, _CYCLES * bin_Hz), min(_HIGHEST_Hz, 0.45 / interval_s)
    if highest_Hz - lowest_Hz < _FEWEST * bin_Hz:  # sampled too slowly, or too short
        return none
    # In parts of its largest value, so that no power of it is out of the range of numbers.
    if not (scale_um := float(np.abs(residual_um).max())) > 0:
        return none
    residual = residual_um / scale_um
    # An octave beyond both ends tells a peak there from a slope.
    spectrum = _Spectrum.of(_power(residual), bin_Hz, lowest_Hz / 2, 2 * highest_Hz)
    inside = (spectrum.frequency_Hz > lowest_Hz) & (spectrum.frequency_Hz < highest_Hz)
    if inside.sum() < _FEWEST or not spectrum.power.min() > 0:
        return none
    floor = spectrum.floor()
    _, nothing = spectrum.fit(floor, None)
    start = spectrum.start(floor, spectrum.frequency_Hz[inside], bin_Hz)
    (*_, height, middle, quality), found = spectrum.fit(floor, np.log(start))
    middle_Hz, quality = float(np.exp(middle)), float(np.exp(quality))
    best, width_Hz = round(middle_Hz / bin_Hz), middle_Hz / quality
    bins = max(round(width_Hz / bin_Hz), 1)
    if not lowest_Hz < middle_Hz < highest_Hz:
        return none
    played = bins <= _LINE and _played(_power(command_V), best)
    # It goes on throughout: no block has nearly all of it.
    swing = np.exp(-2j * np.pi * middle_Hz * interval_s * np.arange(n)) * (residual - residual.mean())
    blocks = np.array([np.abs(block.sum()) ** 2 for block in np.array_split(swing, 8)])
    if np.sort(blocks)[-2:].sum() > 0.85 * blocks.sum():
        return none
    if not _steady(residual, best / n, 2 * width_Hz * interval_s):
        return none
    # The area of the peak, whose bins stand for two each.
    square = float(np.exp(height) * np.pi / 2 * width_Hz / bin_Hz * 2 / n)
    # Noise of this width forgets its phase within a third of as many cycles as its quality.
    forgets = max(quality / np.pi, 1.0) / (middle_Hz * interval_s)
    if _comes_back(residual, command_V, forgets) > _SHARE * square:
        return none
    size_um = scale_um * square**0.5
    # Noise of this width has so many independent values.
    sd_um = size_um / (2 * max(width_Hz * n * interval_s, 1.0) ** 0.5)
    z = max(2 * (found - nothing - np.log(inside.sum())), 0.0) ** 0.5
    return Band(middle_Hz, size_um, sd_um, quality, float(z), 1 / interval_s, bins, played)


def line_in(
    residual_um: FloatArray, interval_s: float, used: np.ndarray, band: Band
) -> tuple[float, FloatArray] | None:
    """The sine throughout an evenly sampled residual that makes a band: its frequency in Hz, and itself, `(n,)`.

    Its phase is that of the samples that are `used`, shape `(n,)`. None where most of the band is no such sine.
    """
    n = len(residual_um)
    bin_Hz, turns = 1 / (n * interval_s), 2j * np.pi * interval_s * np.arange(n)
    left = np.where(used, residual_um - residual_um[used].mean(), 0.0)

    def swing(frequency_Hz: float) -> FloatArray:
        columns = np.exp(turns * frequency_Hz)
        both = np.stack([columns.real, columns.imag], axis=1)
        return np.asarray(both @ np.linalg.lstsq(both[used], left[used], rcond=None)[0])

    def rest(frequency_Hz: float) -> float:
        return float(np.sum((left - swing(frequency_Hz))[used] ** 2))

    middle_Hz = min(band.frequency_Hz + bin_Hz * np.arange(-_LINE, _LINE + 1) / 2, key=rest)
    within = middle_Hz - bin_Hz / 2, middle_Hz + bin_Hz / 2
    found = minimize_scalar(rest, bounds=within, method="bounded", options={"xatol": 1e-4 * bin_Hz})
    best_Hz = float(found.x)
    wave = swing(best_Hz)
    near = np.abs(np.fft.rfftfreq(n, interval_s) - middle_Hz) <= 2 * _LINE * bin_Hz
    before, after = (float(_power(values)[near].sum()) for values in (left, left - np.where(used, wave, 0.0)))
    return (best_Hz, wave) if after < (1 - _SHARE) * before else None


def may_hold(band: Band, residual_um: FloatArray, interval_s: float, chance: float) -> bool:
    """Whether a residual, evenly sampled, of shape `(n,)`, may hold a band that another one showed.

    It holds too little where noise of that width makes as little with a probability below `chance`, even with half
    its variance. A residual that is too short, or too slowly sampled, may hold any.
    """
    n, middle_Hz = len(residual_um), band.frequency_Hz
    if not _CYCLES / (n * interval_s) < middle_Hz < 0.45 / interval_s:
        return True
    power = _power(residual_um)
    width_Hz = middle_Hz / max(band.quality, 1.0)
    near = np.abs(np.fft.rfftfreq(n, interval_s) - middle_Hz) <= max(width_Hz, _LINE / 2 / (n * interval_s))
    part = 2 / n * float(power[near].sum()) / (_SHARE * band.size_um**2)
    freedom = 2 * max(width_Hz * n * interval_s, 1.0)
    return bool(stats.chi2.cdf(freedom * part, freedom) >= chance)


def _comes_back(residual: FloatArray, command_V: FloatArray, apart: float) -> float:
    """Variance of what is the same wherever the command goes up, or down, through the same voltage again.

    Instants are compared that are so many samples apart, or more.
    """
    falling = np.gradient(command_V) < 0
    return repeated_square(command_V + 2 * np.ptp(command_V) * falling, residual, apart / 5)


def _power(values: FloatArray) -> FloatArray:
    """Spectrum under a Hann window, whose mean over the bins is the variance of white noise."""
    window = np.hanning(len(values))
    return np.asarray(np.abs(np.fft.rfft((values - values.mean()) * window)) ** 2 / np.sum(window**2))


@dataclass(frozen=True)
class _Spectrum:
    """Averages of a spectrum and their numbers of independent bins, shapes `(k,)`, and hat functions, `(k, m)`."""

    frequency_Hz: FloatArray
    power: FloatArray
    count: FloatArray
    hats: FloatArray

    @classmethod
    def of(cls, power: FloatArray, bin_Hz: float, lowest_Hz: float, highest_Hz: float) -> "_Spectrum":
        """Average neighbours where many are within a small part of their frequency."""
        first, stop = max(int(lowest_Hz / bin_Hz), 2), min(int(highest_Hz / bin_Hz) + 1, len(power) - 1)
        edges = [first]
        while edges[-1] < stop:
            edges.append(edges[-1] + max(int(edges[-1] * _TOGETHER), 1))
        edges[-1] = max(stop, first + 1)
        bins = np.diff(edges)
        frequency_Hz = (np.array(edges[:-1]) + (bins - 1) / 2) * bin_Hz
        mean = np.add.reduceat(power[: edges[-1]], edges[:-1]) / bins
        octaves = np.log2(frequency_Hz)
        knots = np.linspace(octaves[0], octaves[-1], max(round((octaves[-1] - octaves[0]) / _OCTAVES), 1) + 1)
        hats = np.stack([np.interp(octaves, knots, one) for one in np.eye(len(knots))], axis=1)
        mean = np.maximum(mean, _ROUNDING * mean.max())
        return cls(frequency_Hz, mean, np.asarray(_INDEPENDENT * bins), hats)

    def floor(self) -> FloatArray:
        """Logarithm of the floor at its knots: medians around them, which a narrow band does not move."""
        logarithm = np.log(self.power)
        return np.array([np.median(logarithm[hat > 0.3]) for hat in self.hats.T]) - np.log(np.log(2))

    def fit(self, floor: FloatArray, peak: FloatArray | None) -> tuple[FloatArray, float]:
        """Maximise the likelihood from a floor and the logarithms of a peak's height, middle and quality, if any."""
        knots = len(floor)

        def cost(unknowns: FloatArray) -> tuple[float, FloatArray]:
            level = np.exp(self.hats @ unknowns[:knots])
            slopes = [self.hats * level[:, None]]
            if peak is not None:
                height, middle, quality = np.exp(unknowns[knots:])
                off = 2 * quality * (self.frequency_Hz / middle - 1)
                lorentzian = height / (1 + off**2)
                bent = 2 * lorentzian * off / (1 + off**2)
                slopes += [lorentzian[:, None], (bent * (off + 2 * quality))[:, None], (-bent * off)[:, None]]
                level = level + lorentzian
            ratio = self.power / level
            gradient = np.concatenate(slopes, axis=1).T @ (self.count * (1 - ratio) / level)
            return float(self.count @ (np.log(level) + ratio)), gradient

        start = floor if peak is None else np.concatenate([floor, peak])
        least, most = np.log(self.frequency_Hz[[0, -1]])
        # So near the powers there are, the smallest of which are rounding, that no exponential overflows.
        heights = floor.min() - _REACH, max(floor.max(), np.log(self.power.max())) + _REACH
        shapes = [heights, (least, most), (0.0, np.log(_QUALITIES[-1]))]
        bounds = [*zip(floor - _REACH, floor + _REACH, strict=True), *([] if peak is None else shapes)]
        found = minimize(cost, start, jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": 300})
        return found.x, -float(found.fun)

    def start(self, floor: FloatArray, middles_Hz: FloatArray, bin_Hz: float) -> FloatArray:
        """Height, middle and quality of the peak that adds most to the likelihood of a floor."""
        level = np.exp(self.hats @ floor)
        ratio, best, found = self.power / level, -np.inf, np.ones(3)
        for quality in _QUALITIES:
            # So close together that none is missed, and no band narrower than two bins.
            lowest, highest = float(middles_Hz[0]), float(middles_Hz[-1])
            some = np.geomspace(lowest, highest, round(4 * quality * np.log(highest / lowest)))
            some = middles_Hz[np.unique(np.searchsorted(middles_Hz, some[some > 2 * quality * bin_Hz]))]
            off = 2 * quality * (self.frequency_Hz[None, :] / some[:, None] - 1)
            for height in _HEIGHTS:
                more = height / (1 + off**2)
                gain = (ratio * more / (1 + more) - np.log1p(more)) @ self.count
                if len(gain) and gain.max() > best:
                    at = int(np.argmax(gain))
                    best = float(gain[at])
                    found = np.array([height * np.interp(some[at], self.frequency_Hz, level), some[at], quality])
        return found


def _played(played: FloatArray, at: int) -> bool:
    """Whether a bin is at a multiple of a line of the command's spectrum: a loop played again and again has some."""
    lines = median_filter(played, 2 * (len(played) // 16) + 1, mode="nearest")
    for k in range(1, 13):
        middle = round(at / k)
        near = slice(max(middle - 2, 1), middle + 3)
        if middle > _CYCLES and played[near].max() > max(1e3 * lines[middle], 1e-4 * played.sum()):
            return True
    return False


def _steady(values: FloatArray, middle: float, width: float) -> bool:
    """Whether what is in a band, in parts of the sampling rate, is as strong throughout as noise of that width."""
    # Each block has some eight independent numbers; of fewer blocks none is told from chance.
    blocks = min(round(width * len(values) / 4), 8)
    if blocks < 4:
        return True
    spectrum = np.fft.rfft(values - values.mean())
    frequency = np.fft.rfftfreq(len(values))
    part = np.fft.irfft(np.where(np.abs(frequency - middle) < width / 2, spectrum, 0.0), len(values))
    powers = np.sort([float(block @ block) for block in np.array_split(part, blocks)])
    return bool(powers[1] > 0.25 * powers.mean())  # as nearly every eighth of a record has
