"""What repeats itself with the position, as the error of an interferometer or an encoder does."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats
from scipy.optimize import minimize_scalar

# Periods in the stroke, fewest and most: what is slower is density. Bins of the stroke, and of what it is padded to.
_FEWEST, _MOST, _BINS, _PADDED = 8, 2000, 2**15, 2**16
# Periods that are tried around the best of those.
_BETWEEN = 21


@dataclass(frozen=True)
class Cycles:
    """The strongest period of residuals in the position: its evidence in e-folds, and the decrease that it takes."""

    period_um: float
    z: float
    drop: float


def cycles(residuals: Sequence[np.ndarray], positions_um: Sequence[np.ndarray]) -> Cycles:
    """Search residuals of some runs, in noise, for a period in their positions, shape `(n,)` each.

    Each run has an amplitude and a phase of its own. Where more than noise is left, the evidence is in units of that.
    """
    low_um = min(float(position.min()) for position in positions_um)
    span_um = max(max(float(position.max()) for position in positions_um) - low_um, 1e-300)
    first, stop = (round(count * _PADDED / _BINS) for count in (_FEWEST, _MOST))
    drops = np.zeros(stop - first)
    for residual, position in zip(residuals, positions_um, strict=True):
        place = np.minimum((_BINS * (position - low_um) / span_um).astype(int), _BINS - 1)
        lines = np.fft.rfft(np.bincount(place, residual, _BINS), _PADDED)[first:stop]
        drops += 2 * np.abs(lines) ** 2 / max(float(residual @ residual), len(residual))
    best = int(np.argmax(drops))
    logs = stats.chi2.logsf(drops[best], 2 * len(residuals)) + np.log(len(drops))

    def drop(rate: float) -> float:
        turns = (2 * np.pi * rate / span_um * position for position in positions_um)
        lines = (residual @ np.exp(1j * turn) for residual, turn in zip(residuals, turns, strict=True))
        return sum(2 * float(abs(line)) ** 2 / len(one) for line, one in zip(lines, residuals, strict=True))

    near = (first + best + np.array([-1, 1])) * _BINS / _PADDED
    rate = float(minimize_scalar(lambda rate: -drop(rate), bounds=near, method="bounded").x)
    return Cycles(span_um / rate, float(-logs), drop(rate))


def without_cycles(
    residual_um: np.ndarray, position_um: np.ndarray, period_um: float, used: np.ndarray
) -> np.ndarray:
    """Take off what repeats itself with a period, as it is in the samples `used`; shape `(n,)`."""
    turn = 2 * np.pi * position_um / period_um
    waves = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    multiples = np.linalg.lstsq(waves[used], residual_um[used] - np.mean(residual_um[used]), rcond=None)[0]
    return residual_um - waves @ multiples
