"""Noise of a sensor and of residuals: how large, how correlated, and where a record shows it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

# Huber's bound, in standard deviations: 95 % efficient on clean Gaussian noise.
_HUBER = 1.345
LOSSES = ("squares", "huber")
# Samples of which it is seen whether a residual repeats itself.
_COMPARED = 1_000_000


def shared_square(residual: np.ndarray) -> float:
    """Mean autocovariance at lags 1 to 10: about zero for white noise, which may make it negative."""
    centred = residual - residual.mean()
    furthest = min(10, len(residual) - 1)
    products = [float(np.mean(centred[lag:] * centred[:-lag])) for lag in range(1, furthest + 1)]
    return float(np.mean(products)) if products else 0.0


def correlation_samples(residuals: Sequence[np.ndarray]) -> float:
    """Estimate the integrated correlation time of the residuals of some runs, in samples; 1 for white noise.

    Least squares rests on `n / correlation_samples` independent samples. See A. Sokal, "Monte Carlo Methods in
    Statistical Mechanics" (1997), section 3.
    """
    total = np.zeros(max(len(r) for r in residuals))
    for residual in residuals:
        n = len(residual)
        size = fast_length(2 * n)
        spectrum = np.abs(np.fft.rfft(residual - residual.mean(), size)) ** 2
        total[:n] += np.fft.irfft(spectrum, size)[:n]
    if total[0] <= 0:
        return 1.0
    time = 1 + 2 * np.cumsum(total[1:] / total[0])
    inside = np.flatnonzero(np.arange(1, len(total)) >= 5.0 * time)  # Sokal's window
    return float(max(1.0, time[inside[0]] if len(inside) else time.max(initial=1.0)))


def fast_length(least: int) -> int:
    """A length whose Fourier transform is quick, a quarter longer at most: one that is even and has small primes."""
    return min(part << max((-(-least // part) - 1).bit_length(), 1) for part in (4, 5, 6, 7))


def repeated_square(place: np.ndarray, residual: np.ndarray, correlation: float) -> float:
    """Variance of what a residual repeats wherever it comes back to the same place; 0 where noise may do that, too.

    The products of pairs that are closest in place are compared, of samples so far apart in time that they share no
    noise, if one in so many samples as `correlation` is independent. Of a very long residual some samples are taken,
    evenly chosen.
    """
    centred, every = residual - residual.mean(), -(-len(place) // _COMPARED)
    place, centred = place[::every], centred[::every]
    correlation = max(correlation / every, 1.0)
    order = np.argsort(place, kind="stable")
    one, other = (np.concatenate(part) for part in zip(*((order[k:], order[:-k]) for k in range(1, 9)), strict=True))
    apart = np.abs(one - other) > 5 * correlation
    one, other = one[apart], other[apart]
    count, away = min(len(one), len(place) // 2), np.abs(place[one] - place[other])
    if count < 50:
        return 0.0
    farthest = np.partition(away, count - 1)[count - 1]
    # Of those as far away as the last that is taken, the first ones.
    closest = np.concatenate([np.flatnonzero(away < farthest), np.flatnonzero(away == farthest)])[:count]
    products = centred[one[closest]] * centred[other[closest]]
    mean = float(products.mean())
    return mean if mean > float(products.std()) * (correlation / len(products)) ** 0.5 else 0.0


def huber_weight(residual_um: np.ndarray, fitted: np.ndarray) -> np.ndarray:
    """Weigh samples by what they leave, shape `(n,)`: outliers count linearly (Huber)."""
    left = residual_um[fitted]
    middle = float(np.median(left))
    # The median absolute deviation is not moved by the outliers themselves.
    spread = 1.4826 * float(np.median(np.abs(left - middle))) + 1e-300
    return np.asarray(_HUBER / np.maximum(np.abs(residual_um - middle) / spread, _HUBER))


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
        from scipy.signal import lfilter  # slow to import, and white noise needs none of it

        impulse = np.zeros(4096)
        impulse[0] = 1.0
        return self.innovation_um * float(np.linalg.norm(lfilter([1.0], np.r_[1.0, -self.past], impulse)))

    @property
    def correlation_samples(self) -> float:
        """Samples that are worth one independent one."""
        return float((self.innovation_um / (1 - np.sum(self.past)) / self.total_um) ** 2)

    def relative_spectrum(self, radians: np.ndarray) -> np.ndarray:
        """Power at frequencies in radians per sample, shape `(n,)`; one in the mean."""
        lags = np.arange(1, len(self.past) + 1)
        answer = 1 - np.exp(-1j * radians[:, None] * lags) @ self.past
        return (self.innovation_um / self.total_um) ** 2 / np.abs(answer) ** 2

    def followed_by(self, other: "Noise") -> "Noise":
        """The noise that is left as another one where it is whitened by this one."""
        past = -np.convolve(np.r_[1.0, -self.past], np.r_[1.0, -other.past])[1:]
        return Noise(self.innovation_um * other.innovation_um, past)

    def whiten(self, values: np.ndarray) -> np.ndarray:
        """Turn noise into independent numbers of variance one, along the first axis."""
        # SciPy filters no array without columns.
        if len(self.past) and values.size:
            from scipy.signal import lfilter

            values = lfilter(np.r_[1.0, -self.past], [1.0], values, axis=0)
        if self.spread is not None:
            values = values / self.spread.reshape(-1, *(1,) * (values.ndim - 1))
        return values / self.innovation_um

    def colour(self, values: np.ndarray) -> np.ndarray:
        """Undo that, for values of one signal, shape `(n,)`."""
        values = self.innovation_um * (values if self.spread is None else values * self.spread)
        if len(self.past):
            from scipy.signal import lfilter

            values = lfilter([1.0], np.r_[1.0, -self.past], values)
        return values


def rough_noise_um(residual_um: np.ndarray) -> float:
    """Standard deviation of white noise in a residual, by its second differences, whatever slowly changes."""
    second = np.diff(residual_um, 2)
    return float(1.4826 * np.median(np.abs(second - np.median(second))) / 6**0.5)


def learn_noise(residual_um: np.ndarray, freedom: float, order: int = 8) -> Noise:
    """Learn the noise of a residual by Yule-Walker, its order by BIC; `freedom` unknowns were fitted to it."""
    from scipy.linalg import solve_toeplitz

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


def stretches(flags: np.ndarray) -> list[tuple[int, int]]:
    """First sample, and that after the last, of each stretch of flags that are set."""
    edges = np.flatnonzero(np.diff(flags.astype(int), prepend=0, append=0))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


def idle_stretches(voltage_V: np.ndarray, settling: int) -> list[slice]:
    """Stretches in which the command has rested for a while, and for so many samples at least."""
    found = []
    for first, stop in stretches(np.diff(voltage_V) == 0):
        begin = max(first + (stop - first) // 3, first + settling)
        if stop - begin >= 16:
            found.append(slice(begin, stop))
    return found


def quantum_um(values_um: np.ndarray) -> float:
    """Last digit of a sensor: the spacing of which all readings are multiples; 0 where there is none."""
    distinct = np.unique(values_um)
    if len(distinct) < 3 or len(distinct) > 0.7 * len(values_um):
        return 0.0
    gaps = np.diff(distinct)
    gaps = gaps[gaps > 1e-9 * float(np.ptp(distinct))]
    smallest = float(np.quantile(gaps, 0.05))
    spacing = float(np.median(gaps[gaps < 1.5 * smallest]))
    turns = (distinct - distinct[0]) / spacing
    # Refined over the whole range, where a small error of the spacing adds up.
    whole = np.round(turns)
    for _ in range(3):
        spacing = float(whole @ (distinct - distinct[0]) / (whole @ whole))
        whole = np.round((distinct - distinct[0]) / spacing)
    off = np.abs((distinct - distinct[0]) / spacing - whole)
    return spacing if float(np.mean(off < 0.1)) > 0.95 else 0.0
