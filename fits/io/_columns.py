"""Which further columns of a record are the temperature and the second axis."""

import numpy as np

from fits.io._record import Record

# Correlation beyond which a column is another reading of the same.
_ALIKE = 0.99
# Part of a record through which a temperature hardly bends.
_BEGINNING = 0.02
PATH = "path_V"
"""Name of a column that says through how many volts the command went before each sample, other records included."""


def columns_beside(record: Record) -> dict[str, np.ndarray]:
    """Further columns of a record under the names that effects know, shape `(n,)` each.

    A name that begins with `temp`, or is in degrees, is `temperature_degC`; another one in a unit of length is the
    second axis, `other_um`, unless it goes with the time, the voltage or the displacement: that is another reading
    of this axis. `path_V` is itself. A column that does not change shows nothing.

    What lags behind the temperature starts from rest at its first value. That one is read off a line through the
    first readings: its noise would act like a step.
    """
    found: dict[str, np.ndarray] = {}
    for name, values in record.extra.items():
        low = name.lower()
        if name == PATH:
            found[name] = values
            continue
        if np.ptp(values) == 0 or not np.all(np.isfinite(values)):
            continue
        if low.startswith("temp") or low.endswith(("_degc", "_temperature_k", "_temperature_c")):
            found.setdefault("temperature_degC", np.concatenate([[_first(record.time_s, values)], values[1:]]))
        elif low.endswith(("_um", "_nm", "_mm", "_m")) and not _of_this_axis(record, values):
            found.setdefault("other_um", values)
    return found


def _of_this_axis(record: Record, values: np.ndarray) -> bool:
    own = [record.time_s, record.voltage_V, record.displacement_um]
    return any(abs(np.corrcoef(values, one)[0, 1]) > _ALIKE for one in own if one is not None and np.ptp(one) > 0)


def _first(time_s: np.ndarray, values: np.ndarray) -> float:
    """The first value, by a line through the first part of all."""
    count = int(_BEGINNING * len(values))
    if count < 3:
        return float(values[0])
    return float(np.polynomial.Polynomial.fit(time_s[:count], values[:count], 1)(time_s[0]))
