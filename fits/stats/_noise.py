"""How many samples of a residual are worth one independent one."""

from collections.abc import Sequence

import numpy as np
from scipy import fft

# Huber's bound, in standard deviations: 95 % efficient on clean Gaussian noise.
_HUBER = 1.345
# A residual less correlated than this counts as white.
WHITE = 1.2
LOSSES = ("squares", "huber")
# Sokal's window: sum the correlations up to this many correlation times.
_WINDOW = 5.0


# Neighbours this close share an error of the model, but not white noise.
_NEIGHBOURS = 10


def shared_square(residual: np.ndarray) -> float:
    """Mean square of the part of a residual that neighbouring samples share, in its unit squared.

    That is the mean of the autocovariances at lags 1 to 10: white noise has none, model discrepancy has. As an
    estimate it can come out negative.
    """
    centred = residual - residual.mean()
    furthest = min(_NEIGHBOURS, len(residual) - 1)
    products = [float(np.mean(centred[lag:] * centred[:-lag])) for lag in range(1, furthest + 1)]
    return float(np.mean(products)) if products else 0.0


def correlation_samples(residuals: Sequence[np.ndarray]) -> float:
    """Estimate the integrated correlation time of the residuals of some runs, in samples; 1 for white noise.

    Least squares rests on `n / correlation_samples` samples' worth of evidence. See A. Sokal, "Monte Carlo Methods in
    Statistical Mechanics" (1997), section 3.
    """
    longest = max(len(r) for r in residuals)
    total = np.zeros(longest)
    for residual in residuals:
        n = len(residual)
        spectrum = np.abs(fft.rfft(residual - residual.mean(), fft.next_fast_len(2 * n))) ** 2
        total[:n] += fft.irfft(spectrum)[:n]
    if total[0] <= 0:
        return 1.0
    time = 1 + 2 * np.cumsum(total[1:] / total[0])
    lag = np.arange(1, longest)
    inside = np.flatnonzero(lag >= _WINDOW * time)
    return float(max(1.0, time[inside[0]] if len(inside) else time.max(initial=1.0)))


def huber_weight(residual_um: np.ndarray, fitted: np.ndarray) -> np.ndarray:
    """Weigh samples by what they leave, shape `(n,)`: outliers count linearly (Huber)."""
    left = residual_um[fitted]
    middle = float(np.median(left))
    # The median absolute deviation is not moved by the outliers themselves.
    spread = 1.4826 * float(np.median(np.abs(left - middle))) + 1e-300
    return np.asarray(_HUBER / np.maximum(np.abs(residual_um - middle) / spread, _HUBER))
