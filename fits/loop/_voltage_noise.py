"""Noise in the readings of a voltage, which the stage never saw."""

from collections.abc import Sequence

import numpy as np

from fits.io._length import length
from fits.loop._run import Run

# Weights of the quadratic through nine neighbours (Savitzky & Golay, Analytical Chemistry 36 (1964) 1627): of a
# signal that is smooth over so many samples it leaves the noise.
_WEIGHTS = tuple(one / 231 for one in (-21, 14, 39, 54, 59, 54, 39, 14, -21))
# Robust standard deviations beyond which the command itself turns or steps.
_TURNS_Z = 5.0
# The model follows at least so much of it that the displacement does not, and it makes at least such a part of the
# fastest changes that are left.
_MOSTLY, _PART = 0.5, 0.1
# Standard deviations that are no chance.
_SURE_Z = 8.0


def noisy_voltages(runs: Sequence[Run], left_um: Sequence[np.ndarray]) -> list[str]:
    """Find runs whose voltage moves from sample to sample as the displacement does not, by what a model leaves.

    The latter is measurement less prediction, in um, shape `(n,)` each.
    """
    return [said for run, left in zip(runs, left_um, strict=True) for said in _noisy(run, left)]


def _noisy(run: Run, left_um: np.ndarray) -> list[str]:
    voltage, reading, left = map(_fast, (run.record.voltage_V, run.displacement_um, left_um))
    spread = 1.4826 * float(np.median(np.abs(voltage))) if len(voltage) else 0.0
    half = len(_WEIGHTS) // 2
    used = run.fitted[half : len(run.fitted) - half] & (np.abs(voltage) < _TURNS_Z * spread)
    if used.sum() < len(_WEIGHTS):
        return []
    voltage, reading, left = (one[used] for one in (voltage, reading, left))
    square = float(voltage @ voltage)
    follows, lacks = float((reading - left) @ voltage) / square, -float(left @ voltage) / square
    rest = left + lacks * voltage
    sure = lacks * square**0.5 / max(float(np.sqrt(np.mean(rest**2))), 1e-300)
    part = lacks**2 * square / max(float(left @ left), 1e-300)
    if not (follows > 0 and lacks > _MOSTLY * follows and part > _PART and sure > _SURE_Z):
        return []
    # Of white noise the quadratic takes as much away as its middle weighs.
    noise_V = float((square / len(voltage) / (1 - _WEIGHTS[half])) ** 0.5)
    return [
        f"{run.record.source}: the voltage carries noise of {noise_V:.2g} V, which the displacement does not follow "
        f"and the model does: {length(follows * noise_V)} of what is left; give the voltage that was commanded, or "
        "the mean of many periods"
    ]


def _fast(values: np.ndarray) -> np.ndarray:
    """What a quadratic through its neighbours leaves of each sample but those at the ends, shape `(n - 8,)`."""
    half = len(_WEIGHTS) // 2
    if len(values) < len(_WEIGHTS):
        return np.zeros(0)
    return values[half : len(values) - half] - np.convolve(values, _WEIGHTS, mode="valid")
