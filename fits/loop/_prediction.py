"""What a prediction is, and the programs that none is made of."""

from dataclasses import dataclass

import numpy as np

from fits.io._errors import DataError
from fits.io._record import Record

# Records pass through compiled functions in pieces of this many samples, and so many extremes at most are remembered
# from one to the next.
PIECE, MOST_EXTREMES = 8192, 4096


@dataclass(frozen=True)
class Prediction:
    """Predicted displacement of a voltage program, and its standard deviation, shape `(n,)` each.

    The latter comes from noise and smoothing, sensor noise not included; NaN where it is not known.
    """

    displacement_um: np.ndarray
    displacement_sd_um: np.ndarray


def refuse_outside(record: Record, lower_V: float, upper_V: float) -> None:
    """Refuse, in a `DataError`, a program that leaves the range that a model was fitted on."""
    slack = 1e-9 * (upper_V - lower_V) if np.isfinite(upper_V - lower_V) else 0.0
    outside = np.flatnonzero((record.voltage_V < lower_V - slack) | (record.voltage_V > upper_V + slack))
    if len(outside):
        first = int(outside[0])
        raise DataError(
            f"{record.source}: sample {first + 1} (time {record.time_s[first]:g} s) asks for "
            f"{record.voltage_V[first]:g} V, but the model was fitted between {lower_V:g} and {upper_V:g} V: "
            "clip the program or fit runs that cover it"
        )


def too_deep() -> DataError:
    """Refusal of a voltage that leaves more extremes than are remembered."""
    return DataError(
        f"the voltage nests more than {MOST_EXTREMES} loops into each other: that is noise, not a drive; "
        "use the commanded voltage"
    )
