"""What a prediction is, what it begins from, and the programs that none is made of."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from fits.io._errors import DataError
from fits.io._length import length
from fits.io._record import Record

# Records pass through compiled functions in pieces of this many samples, and so many extremes at most are remembered
# from one to the next.
PIECE, MOST_EXTREMES = 8192, 4096
# What a readback, or rounding, puts beyond the range of a model, as a share of it: taken as the end.
_SLACK = 1e-3


# The memory before a first sample: its name, or its extremes at the hysteresis in V, oldest first.
Initial = str | tuple[float, ...]


@dataclass(frozen=True)
class Prediction:
    """Predicted displacement of a voltage program, and its standard deviation, shape `(n,)` each.

    The latter comes from noise and smoothing, sensor noise not included; NaN where it is not known. `remarks` are
    sentences on the program.
    """

    displacement_um: np.ndarray
    displacement_sd_um: np.ndarray
    remarks: tuple[str, ...] = ()


def predict_from(initial: Initial, predict: Callable[[Initial], Prediction]) -> Prediction:
    """Predict from a memory, be it `unknown`: then midway between those after both ends of the range.

    No relay adds less than nothing, so that whatever came before is between the two; the standard deviation has that
    of an even distribution there.
    """
    if initial != "unknown":
        return predict(initial)
    low, high = predict("negative"), predict("positive")
    half_um = (high.displacement_um - low.displacement_um) / 2
    sd_um = np.sqrt(np.maximum(low.displacement_sd_um, high.displacement_sd_um) ** 2 + half_um**2 / 3)
    widest_um = float(np.abs(half_um).max(initial=0.0))
    said = (
        "what the rig went through before is unknown: the prediction is midway between those after the lowest and "
        f"after the highest voltage, which are up to {length(widest_um)} to either side, and its standard deviation "
        "has that",
    )
    return Prediction(low.displacement_um + half_um, sd_um, (*low.remarks, *(said if widest_um > 0 else ())))


def inside(record: Record, lower_V: float, upper_V: float) -> Record:
    """Return a program whose voltages are inside the range that a model was fitted on.

    Those beyond it by less than a thousandth of the range are taken as its end, with a warning; a `DataError` refuses
    any others.
    """
    slack = _SLACK * (upper_V - lower_V) if np.isfinite(upper_V - lower_V) else 0.0
    outside = np.flatnonzero((record.voltage_V < lower_V - slack) | (record.voltage_V > upper_V + slack))
    if len(outside):
        first = int(outside[0])
        raise DataError(
            f"{record.source}: sample {first + 1} (time {record.time_s[first]:g} s) asks for "
            f"{record.voltage_V[first]:g} V, but the model was fitted between {lower_V:g} and {upper_V:g} V: "
            "clip the program or fit runs that cover it"
        )
    inside_V = np.clip(record.voltage_V, lower_V, upper_V)
    beyond_V = np.abs(record.voltage_V - inside_V)
    if not beyond_V.any():
        return record
    said: tuple[str, ...] = ()
    if beyond_V.max() > 1e-9 * (upper_V - lower_V):  # more than the last digit
        said = (
            f"{record.source}: at {np.count_nonzero(beyond_V)} of {len(record)} samples the voltage is beyond "
            f"{lower_V:g} to {upper_V:g} V, where the model was fitted, by up to {beyond_V.max():.3g} V, and was "
            "taken as the end of that.",
        )
    return replace(record, voltage_V=inside_V, warnings=(*record.warnings, *said))


def too_deep() -> DataError:
    """Refusal of a voltage that leaves more extremes than are remembered."""
    return DataError(
        f"the voltage nests more than {MOST_EXTREMES} loops into each other: that is noise, not a drive; "
        "use the commanded voltage"
    )
