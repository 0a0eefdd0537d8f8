"""What controllers are given where nothing is stated, by the stage and by what they are to follow."""

import numpy as np

from fits.control._tune_start import steepest_slope
from microid import Stage

# Resonators take up an error over so many of their periods.
PERIODS = 3.0
# A table holds this share of the reference's voltage, and its range is wider than the reference's by these.
_TABLE, _ASIDE, _FASTER = 0.5, 0.02, 1.02
_LEARNING = 0.1


def bp_defaults(stage: Stage, reference_um: np.ndarray) -> dict[str, float]:
    """Fields of a `BPPID` by name: the slope it learns by, and the error that is 1 to it.

    Raises
    ------
    DataError
        See `steepest_slope`.
    """
    slope = float(stage.static_gain) * (steepest_slope(stage) or 1.0)
    return {"slope_um_per_V": slope, "scale_um": max(float(np.ptp(reference_um)), 1e-9) / 10}


def cmac_defaults(reference_um: np.ndarray, static_V: np.ndarray, interval_s: float) -> dict[str, float]:
    """Fields of a `CMACPID` by name, beside its PID controller.

    Parameters
    ----------
    reference_um, static_V
        What is followed, and the command that would hold the stage there, shape `(t,)`.
    interval_s
        Between two samples.
    """
    low, high = float(reference_um.min()), float(reference_um.max())
    aside = _ASIDE * max(high - low, 1e-9)
    fastest = float(np.abs(np.diff(reference_um)).max()) / interval_s
    return {
        "lower_um": low - aside,
        "upper_um": high + aside,
        "fastest_um_per_s": _FASTER * fastest + 1e-9,
        "learning_rate": _LEARNING,
        "limit_V": _TABLE * max(float(np.ptp(static_V)), 1e-6),
    }


def strongest_Hz(reference_um: np.ndarray, interval_s: float) -> float | None:
    """Frequency of the strongest line of a reference, between the lines of its transform by a parabola.

    Parameters
    ----------
    reference_um
        Shape `(t,)`.
    interval_s
        Between two samples.

    Returns
    -------
    float or None
        None for a reference that stands still.
    """
    n = len(reference_um)
    size = np.abs(np.fft.rfft((reference_um - reference_um.mean()) * np.hanning(n), 8 * n))
    k = int(np.clip(np.argmax(size), 1, len(size) - 2))
    if size[k] <= 0:
        return None
    left, here, right = np.log(np.maximum(size[k - 1 : k + 2], 1e-300))
    bend = left - 2 * here + right
    return float((k + (0.5 * (left - right) / bend if bend else 0.0)) / (8 * n * interval_s))
