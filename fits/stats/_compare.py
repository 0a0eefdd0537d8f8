"""Errors before and after, compared over blocks that are longer than errors stay alike."""

import numpy as np

_BLOCKS = 24


def improvement_z(before: np.ndarray, after: np.ndarray) -> float:
    """Standard deviations by which errors of shape `(n,)` became smaller; 0 where there are none."""
    blocks = np.array([np.sum(block) for block in np.array_split(before**2 - after**2, _BLOCKS)])
    return float(np.sum(blocks) / max(float(np.linalg.norm(blocks - np.mean(blocks))), 1e-300))


def sd_of_difference(before: np.ndarray, after: np.ndarray) -> float:
    """Standard deviation of the difference of the root mean squares of two errors of shape `(n,)`, linearised."""
    rms0, rms1 = (max(float(np.sqrt(np.mean(one**2))), 1e-300) for one in (before, after))
    influence = before**2 / (2 * rms0) - after**2 / (2 * rms1)
    blocks = np.array([block.mean() for block in np.array_split(influence, _BLOCKS)])
    return float(np.std(blocks, ddof=1) / len(blocks) ** 0.5)
