"""Colour, of first order, of a sensor's noise where nothing is at rest: read off the fastest changes."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fits.stats._noise import Noise

# Power is the median of so many stretches, each so long at least, from which on a misfit of a stage is small.
_STRETCHES, _FEWEST, _SLOWEST = 16, 64, np.pi / 6
# Correlations of neighbours up to this one are tried, in such steps; so many bands of frequencies are compared.
_LARGEST, _STEP, _BANDS = 0.95, 0.01, 8
# A median's standard error over that of a mean, and how much a taper makes neighbouring frequencies agree.
_MEDIAN, _TAPERED = 1.25, 1.5**0.5


@dataclass(frozen=True)
class Spectrum:
    """Logarithm of the power of a residual, um^2 per sample, at some `radians` per sample, both of shape `(n,)`."""

    radians: np.ndarray
    log_power: np.ndarray

    @classmethod
    def of(cls, residual_um: np.ndarray) -> "Spectrum | None":
        """The fast end of a spectrum by medians over stretches (Hann's window), which bursts do not raise."""
        size = len(residual_um) // _STRETCHES
        if size < _FEWEST:
            return None
        time = np.linspace(-1, 1, size)
        pieces = residual_um[: _STRETCHES * size].reshape(_STRETCHES, size).T
        pieces = pieces - np.polynomial.polynomial.polyval(time, np.polynomial.polynomial.polyfit(time, pieces, 2)).T
        taper = np.hanning(size + 2)[1:-1, None]
        power = np.median(np.abs(np.fft.rfft(pieces * taper, axis=0)) ** 2, axis=1) / np.sum(taper**2) / np.log(2)
        radians = 2 * np.pi * np.arange(len(power)) / size
        fast = (radians > _SLOWEST) & (radians < 0.999 * np.pi) & (power > 0)
        return cls(radians[fast], np.log(power[fast])) if np.sum(fast) >= _FEWEST // 4 else None

    def innovation_um(self, correlation: float) -> float:
        """Standard deviation of what is new in every sample, where neighbours are so much correlated."""
        return float(np.exp(np.median(self._off(correlation)) / 2))

    def correlation(self) -> tuple[float, float]:
        """Of neighbours, by least absolute deviations, which lines do not move, and its standard error."""
        tried = np.arange(0.0, _LARGEST + _STEP / 2, _STEP)
        off = np.array([self._off(one) for one in tried])
        best = float(tried[np.argmin(np.sum(np.abs(off - np.median(off, axis=1)[:, None]), axis=1))])
        slope = (self._off(best + 1e-3) - self._off(best - 1e-3)) / 2e-3
        error = _MEDIAN * _TAPERED * self._scatter(best) / np.linalg.norm(slope - slope.mean())
        return best, float(error)

    def follows(self, correlation: float, same_z: float) -> bool:
        """Whether noise of that colour leaves no band of frequencies off by more standard deviations than that."""
        off = self._off(correlation)
        off, scatter = off - np.median(off), self._scatter(correlation)
        most = same_z * _MEDIAN * _TAPERED * scatter
        return all(abs(np.median(band)) * len(band) ** 0.5 < most for band in np.array_split(off, _BANDS))

    def _off(self, correlation: float) -> np.ndarray:
        return self.log_power + np.log(1 + correlation**2 - 2 * correlation * np.cos(self.radians))

    def _scatter(self, correlation: float) -> float:
        off = self._off(correlation)
        return 1.4826 * float(np.median(np.abs(off - np.median(off))))


def coloured(spectra: Sequence[Spectrum | None], same_z: float) -> list[Noise | None]:
    """The noise of runs of one sensor whose neighbours are correlated; None where a run shows no such colour.

    Their correlation is the same unless they are `same_z` standard errors apart, and no less from none.
    """
    shown = [one is not None and one.follows(one.correlation()[0], same_z) for one in spectra]
    known = [one for one, is_shown in zip(spectra, shown, strict=True) if one is not None and is_shown]
    if not known:
        return [None] * len(spectra)
    own, error = np.array([one.correlation() for one in known]).T
    joint = float(np.average(own, weights=error**-2))
    if np.all(np.abs(own - joint) < same_z * error):
        own, error = np.full(len(known), joint), np.full(len(known), float(np.sum(error**-2)) ** -0.5)
    each = zip(known, own, error, strict=True)
    noise = iter([Noise(one.innovation_um(c), np.array([c])) if c > same_z * e else None for one, c, e in each])
    return [next(noise) if is_shown else None for is_shown in shown]
