"""What a prediction is, and the programs that none is made of."""

from dataclasses import dataclass, replace

import numpy as np

from fits.io._errors import DataError
from fits.io._record import Record

# Records pass through compiled functions in pieces of this many samples, and so many extremes at most are remembered
# from one to the next.
PIECE, MOST_EXTREMES = 8192, 4096
# What a readback, or rounding, puts beyond the range of a model, as a share of it: taken as the end.
_SLACK = 1e-3


@dataclass(frozen=True)
class Prediction:
    """Predicted displacement of a voltage program, and its standard deviation, shape `(n,)` each.

    The latter comes from noise and smoothing, sensor noise not included; NaN where it is not known. `remarks` are
    sentences on the program.
    """

    displacement_um: np.ndarray
    displacement_sd_um: np.ndarray
    remarks: tuple[str, ...] = ()


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
