"""The temperature of the stage's body."""

import numpy as np

from fits.io._quantity import FloatArray, Quantity
from fits.io._record import Record
from fits.io.columns._base import Column, register


def _recognised(name: str, values: FloatArray, record: Record) -> bool:
    return name.lower().startswith("temp") or name.lower().endswith(("_degc", "_temperature_k", "_temperature_c"))


def _first_smoothed(values: FloatArray, record: Record) -> FloatArray:
    """Replace the first value by that of a line through the first readings: what lags behind begins at rest there."""
    count = int(0.02 * len(values))
    if count < 3:
        return values
    line = np.polynomial.Polynomial.fit(record.time_s[:count], values[:count], 1)
    return np.concatenate([[line(record.time_s[0])], values[1:]])


TEMPERATURE = register(
    Column(
        Quantity("temperature", "degC", {"degC": 0, "C": 0, "K": 0}),
        recognised=_recognised,
        cleaned=_first_smoothed,
        title="temperature",
        use="the temperature of the stage's body, which what the room does follows and what the command does "
        "ignores.",
    )
).key
