"""Noise of one run, and how it is learnt."""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_toeplitz
from scipy.signal import lfilter


@dataclass(frozen=True)
class Noise:
    """Noise of one run: its innovations' standard deviation, and how it depends on its past.

    `past` holds the coefficients of an autoregression, none for white noise. `spread` is the factor by which a sample
    is noisier than that, shape `(n,)`; None where all are alike.
    """

    innovation_um: float
    past: np.ndarray
    spread: np.ndarray | None = None

    @property
    def total_um(self) -> float:
        """Standard deviation of the noise itself."""
        if len(self.past) == 0:
            return self.innovation_um
        impulse = np.zeros(4096)
        impulse[0] = 1.0
        return self.innovation_um * float(np.linalg.norm(lfilter([1.0], np.r_[1.0, -self.past], impulse)))

    @property
    def correlation_samples(self) -> float:
        """Samples that are worth one independent one."""
        return float((self.innovation_um / (1 - np.sum(self.past)) / self.total_um) ** 2)

    def whiten(self, values: np.ndarray) -> np.ndarray:
        """Turn noise into independent numbers of variance one, along the first axis."""
        # SciPy filters no array without columns.
        if len(self.past) and values.size:
            values = lfilter(np.r_[1.0, -self.past], [1.0], values, axis=0)
        if self.spread is not None:
            values = values / self.spread.reshape(-1, *(1,) * (values.ndim - 1))
        return values / self.innovation_um


def rough_noise_um(residual_um: np.ndarray) -> float:
    """Standard deviation of white noise in a residual, by its second differences, whatever slowly changes."""
    second = np.diff(residual_um, 2)
    return float(1.4826 * np.median(np.abs(second - np.median(second))) / 6**0.5)


def learn_noise(residual_um: np.ndarray, freedom: float, order: int = 8) -> Noise:
    """Learn the noise of a run from what nothing explains, `freedom` unknowns having been fitted to it.

    The Bayesian information criterion chooses the order of the autoregression (Yule-Walker).
    """
    n = len(residual_um)
    inflate = (n / max(n - freedom, n / 2)) ** 0.5
    lags = np.array([residual_um[: n - k] @ residual_um[k:] / n for k in range(order + 1)])
    best, past, variance = np.inf, np.zeros(0), lags[0]
    for k in range(order + 1):
        coefficients = solve_toeplitz(lags[:k], lags[1 : k + 1]) if k else np.zeros(0)
        error = lags[0] - coefficients @ lags[1 : k + 1]
        score = n * np.log(error) + k * np.log(n)
        # A correlation too small to matter is not worth a filter.
        if score < best - 6:
            best, past, variance = score, coefficients, error
    return Noise(float(np.sqrt(variance)) * inflate, past)
