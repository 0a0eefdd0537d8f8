"""How improbable errors are, and errors before and after, compared over blocks longer than errors stay alike."""

import numpy as np
from scipy.fft import dct

from fits.stats._noise import Noise

_BLOCKS = 24


def improvement_z(before: np.ndarray, after: np.ndarray, allowed: float = 0.0) -> float:
    """Standard deviations by which errors of shape `(n,)` became smaller; 0 where there are none.

    By as much as is `allowed` their sum of squares may grow.
    """
    blocks = np.array([np.sum(block) for block in np.array_split(before**2 - after**2, _BLOCKS)])
    return float((np.sum(blocks) + allowed) / max(float(np.linalg.norm(blocks - np.mean(blocks))), 1e-300))


def is_worse(before: np.ndarray, after: np.ndarray, worse_z: float, most: float, allowed: float = 0.0) -> bool:
    """Whether errors, shape `(n,)`, grew by so many standard deviations, or their mean square by more than a part.

    Where a few slow errors make them up, much worse is no more than chance by the first. By as much as is `allowed`
    their sum of squares may grow.
    """
    grown = float(np.sum(after**2) - np.sum(before**2)) - allowed
    return improvement_z(before, after, allowed) < -worse_z or grown > most * float(np.sum(before**2))


def sd_of_difference(before: np.ndarray, after: np.ndarray) -> float:
    """Standard deviation of the difference of the root mean squares of two errors of shape `(n,)`, linearised."""
    rms0, rms1 = (max(float(np.sqrt(np.mean(one**2))), 1e-300) for one in (before, after))
    influence = before**2 / (2 * rms0) - after**2 / (2 * rms1)
    blocks = np.array([block.mean() for block in np.array_split(influence, _BLOCKS)])
    return float(np.std(blocks, ddof=1) / len(blocks) ** 0.5)


def surprise(errors: np.ndarray, noise: Noise) -> float:
    """-2 ln of the probability of errors, in its standard deviations, shape `(n,)`, up to what all have in common.

    It is that of noise beside a discrepancy whose power in each octave of frequency is the most probable (Whittle's
    likelihood): many samples that one slow error spoils count no more than the few waves that make it.
    """
    n = len(errors)
    share = dct(errors, norm="ortho") ** 2 / noise.relative_spectrum(np.pi * np.arange(n) / n)
    octaves = np.r_[0, 2 ** np.arange(int(n - 1).bit_length())] if n > 1 else np.zeros(1, dtype=int)
    count = np.diff(np.r_[octaves, n])
    mean = np.add.reduceat(share, octaves) / count
    return float(np.sum(count * np.where(mean < 1, mean, 1 + np.log(np.maximum(mean, 1.0)))))
