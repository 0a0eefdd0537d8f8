"""Which numbers can be measurements: what lies beyond is a slip of a unit or of an export, and overflows later."""

import numpy as np

from fits.io._quantity import FloatArray
from fits.io._table import Table

# Largest size of a value, and of those in other units. Slips of a unit by 1e6 stay within, so that they are warned
# of in words.
_LARGEST, _LARGEST_BY_UNIT = 1e9, {"s": 1e11, "um^2/V^2": 1e18, "dB": 180.0}
# What changes by less than so much, in V or um, was not measured.
LEAST_CHANGE = 1e-9
SHORTEST_STEP_s = 1e-12


def check_size(table: Table, column: str, values: FloatArray, unit: str, given: str = "") -> None:
    """Refuse values, `(n,)`, that are too large, or change too little, to be measured; `given` is the file's unit."""
    most = _LARGEST_BY_UNIT.get(unit, _LARGEST)
    wrong = ~(np.abs(values) <= most)
    remedy = f"correct the cell, or the unit {given or unit}"
    if wrong.any():
        row = int(np.argmax(wrong))
        what = f"expected numbers from {-most:g} to {most:g} {unit}, found {values[row]:.6g}; {remedy}"
        raise table.error(what, row, column)
    change = float(np.ptp(values))
    if unit in ("V", "um") and 0 < change < LEAST_CHANGE:
        what = f"expected changes of at least {LEAST_CHANGE:g} {unit}, found {change:.3g} in all; {remedy}"
        raise table.error(what, 0, column)
