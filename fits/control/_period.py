"""The period of a reference, by which a resonator is tuned."""

import numpy as np
from scipy.optimize import minimize_scalar

# Spectra have so many times the bins that their samples ask for.
_FINER = 8
# Periods that a reference which is one sine may have, and how little of its variance a sine then leaves.
_ONE, _FEW, _SINE = 0.95, 2.5, 1e-4


def strongest_Hz(reference_um: np.ndarray, interval_s: float) -> float | None:
    """Frequency of the strongest line of a reference, shape `(t,)`; None where no period stands out.

    A line with less than one and a half periods counts as none, since a single move looks the same, unless one sine
    is the whole reference.
    """
    n = len(reference_um)
    size = np.abs(np.fft.rfft((reference_um - reference_um.mean()) * np.hanning(n), _FINER * n))
    k = _FINER + int(np.argmax(size[_FINER:-1]))
    if size[k] <= 0:
        return None
    if k < _FEW * _FINER and (alone_Hz := _one_sine_Hz(reference_um, interval_s)) is not None:
        return alone_Hz
    if k < 1.5 * _FINER:
        return None
    left, here, right = np.log(np.maximum(size[k - 1 : k + 2], 1e-300))
    bend = left - 2 * here + right
    return float((k + (0.5 * (left - right) / bend if bend else 0.0)) / (_FINER * n * interval_s))


def _one_sine_Hz(reference_um: np.ndarray, interval_s: float) -> float | None:
    """Frequency of a reference that is a constant and one sine, of a whole period at least; None for any other."""
    n = len(reference_um)
    wanted_um = reference_um - reference_um.mean()

    def left(periods: float) -> float:
        turn = 2 * np.pi * periods * np.arange(n) / n
        terms = np.stack([np.ones(n), np.cos(turn), np.sin(turn)], axis=1)
        rest_um = wanted_um - terms @ np.linalg.lstsq(terms, wanted_um, rcond=None)[0]
        return float(rest_um @ rest_um / (wanted_um @ wanted_um))

    found = minimize_scalar(left, bounds=(_ONE, _FEW), method="bounded", options={"xatol": 1e-6})
    return float(found.x / (n * interval_s)) if found.fun < _SINE else None
