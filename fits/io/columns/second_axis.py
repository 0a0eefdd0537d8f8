"""The position of a second axis, which may take this one along."""

import numpy as np

from fits.io._quantity import LENGTH, FloatArray, Quantity
from fits.io._record import Record
from fits.io.columns._base import Column, register


def _recognised(name: str, values: FloatArray, record: Record) -> bool:
    """Whether a column is a length, and goes with neither the time, the voltage nor the displacement."""
    if not name.lower().endswith(("_um", "_nm", "_mm", "_m")) or name.lower().startswith("temp"):
        return False
    own = [record.time_s, record.voltage_V, record.displacement_um]
    return not any(abs(np.corrcoef(values, one)[0, 1]) > 0.99 for one in own if one is not None and np.ptp(one) > 0)


register(
    Column(
        Quantity("y_displacement", "um", LENGTH),
        "other_um",
        _recognised,
        title="second axis",
        use="the position of the second axis, without which its share of this one looks like a drift.",
    )
)
