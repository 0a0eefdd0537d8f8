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
# Further columns serve for little, and may hold anything that has a square and a cube.
LARGEST_EXTRA = 1e30


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


def check_steps(table: Table, column: str, time_s: FloatArray) -> None:
    """Refuse, in a `DataError`, increasing times, shape `(n,)`, whose steps double precision cannot resolve."""
    steps_s = np.diff(time_s)
    if not len(steps_s):
        return
    row = int(np.argmin(steps_s))
    # Steps of fewer last digits than these are not even where the clock was.
    least_s = max(SHORTEST_STEP_s, 8 * float(np.spacing(np.abs(time_s[[0, -1]]).max())))
    if steps_s[row] < least_s:
        what = (
            f"expected time steps of at least {least_s:.3g} s, which is what double precision resolves here, found "
            f"{steps_s[row]:.3g} s; begin at 0 s, or check the unit"
        )
        raise table.error(what, row + 1, column)
