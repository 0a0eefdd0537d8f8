"""Where effects are probed."""

import math

import numpy as np


def _decades(first: float, last: float, per_decade: float = 1.0) -> list[float]:
    """Values evenly spaced on a logarithmic scale, from the first up to the last at most; the first in any case."""
    steps = max(math.floor(per_decade * math.log10(last / first) + 1e-9), 0) if last > first else 0
    return [float(value) for value in first * 10 ** (np.arange(steps + 1) / per_decade)]
