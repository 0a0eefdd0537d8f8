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
# Piezo stages move 0.01 um/V (stack on a 1000 V amplifier) to 15 um/V (voltage logged before an amplifier of
# ten-fold gain). Of a typical 0.1 to 1 um/V, slips of 1e3 and 1e6 lie outside these limits.
STROKE_PER_VOLT_MIN_um_per_V = 0.005
STROKE_PER_VOLT_MAX_um_per_V = 50.0


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


def check_time(table: Table, column: str, time_s: FloatArray) -> None:
    """Refuse times in s, `(n,)`, that do not increase, or by less than double precision resolves."""
    wrong = np.flatnonzero(time_s[1:] <= time_s[:-1])
    if wrong.size == 0:
        # Steps of fewer last digits than eight are not even where the clock was.
        least_s = max(SHORTEST_STEP_s, 8 * float(np.spacing(np.abs(time_s[[0, -1]]).max())))
        steps_s = np.diff(time_s)
        if steps_s.min(initial=np.inf) < least_s:
            what = (
                f"expected time steps of at least {least_s:.3g} s, which is what double precision resolves here, "
                f"found {steps_s.min():.3g} s; begin at 0 s, or check the unit"
            )
            raise table.error(what, int(np.argmin(steps_s)) + 1, column)
        return
    row = int(wrong[0]) + 1
    before, now = float(time_s[row - 1]), float(time_s[row])
    if now == before:
        found = f"{now:.9g} s twice; export the time with more digits, or remove the line"
    elif row > 1 and now <= time_s[1]:
        found = f"a restart at {now:.9g} s after {before:.9g} s; split the file here into one file per run"
    else:
        found = f"{now:.9g} s after {before:.9g} s; put the lines in order, or split the file into one file per run"
    raise table.error(f"expected strictly increasing times, found {found}", row, column)


def likely_stroke(ratio_um_per_V: float) -> bool:
    """Whether a piezo stage moves so far per volt."""
    return STROKE_PER_VOLT_MIN_um_per_V <= ratio_um_per_V <= STROKE_PER_VOLT_MAX_um_per_V
