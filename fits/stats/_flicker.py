"""Flicker noise: white noise beside a part whose power falls as one over the frequency."""

from dataclasses import dataclass

import numpy as np
from scipy import stats
from scipy.optimize import minimize

# Parts of the white power with which the search begins.
_STARTS = 1e-4, 1e-2, 1.0


@dataclass(frozen=True)
class Flicker:
    """Power `white + rising / f` at frequencies `f` in cycles per sample; that of white noise is its variance."""

    white: float
    rising: float

    @classmethod
    def of(cls, values: np.ndarray) -> "Flicker":
        """The most probable one of values, shape `(n,)`, by Whittle's likelihood (Ark. Mat. 2 (1953) 423)."""
        frequency, power = _spectrum(values)

        def unlikely(logs: np.ndarray) -> float:
            density = np.exp(logs[0]) + np.exp(logs[1]) / frequency
            return float(np.sum(np.log(density) + power / density))

        white = float(np.log(np.median(power) / np.log(2) + 1e-300))
        starts = (np.array([white, white + np.log(part)]) for part in _STARTS)
        found = min((minimize(unlikely, start, method="Nelder-Mead") for start in starts), key=lambda one: one.fun)
        return cls(*np.exp(found.x).tolist())

    def chance(self, values: np.ndarray) -> float:
        """Probability that such noise has as much power in any octave as these values have, shape `(n,)`."""
        frequency, power = _spectrum(values)
        relative = power / (self.white + self.rising / frequency)
        octave = np.floor(np.log2(frequency * len(values))).astype(int)
        # Each relative power is exponential, and their sum in an octave has a gamma distribution.
        least = min(stats.gamma.sf(relative[octave == k].sum(), np.sum(octave == k)) for k in np.unique(octave))
        return float(min(1.0, least * (octave[-1] + 1)))

    def passed(self, columns: np.ndarray) -> np.ndarray:
        """The covariance of such noise times columns, shape `(n, k)` both."""
        n = len(columns)
        # What is slower than the run is as strong as its slowest.
        density = self.white + self.rising / np.maximum(np.fft.rfftfreq(n), 1 / (2 * n))
        return np.fft.irfft(density[:, None] * np.fft.rfft(columns, axis=0), n, axis=0)


def _spectrum(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Frequencies above none, in cycles per sample, and the power at each."""
    n = len(values)
    return np.arange(1, n // 2 + 1) / n, np.abs(np.fft.rfft(values)[1 : n // 2 + 1]) ** 2 / n
