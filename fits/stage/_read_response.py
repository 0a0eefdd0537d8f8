"""Reading a measured frequency response of one input and one output from a CSV file."""

import os

import numpy as np

from fits.io._plausible import check_size
from fits.io._table import Table, data_error, open_table
from fits.stage._frequency import ResponseData

_REAL, _IMAGINARY, _VARIANCE = "real_um_per_V", "imag_um_per_V", "variance_um2_per_V2"
_MAGNITUDE, _DECIBEL, _DEGREES, _RADIANS = "magnitude_um_per_V", "magnitude_dB", "phase_deg", "phase_rad"
# What a unit is checked by, of each column.
_UNITS = {
    "frequency_Hz": "Hz",
    _REAL: "um/V",
    _IMAGINARY: "um/V",
    _VARIANCE: "um^2/V^2",
    _MAGNITUDE: "um/V",
    _DECIBEL: "dB",
    _DEGREES: "deg",
    _RADIANS: "rad",
}


def read_response(path: str | os.PathLike[str]) -> ResponseData:
    """Read a frequency response as an analyser writes it: a row per line, frequencies increasing.

    The columns are `frequency_Hz`, then `real_um_per_V` and `imag_um_per_V`, or a magnitude (`magnitude_um_per_V`, or
    `magnitude_dB` for 20 log10 of um/V) and a phase (`phase_deg` or `phase_rad`). A column `variance_um2_per_V2`, of
    the complex response, may stand beside them.

    Returns
    -------
    ResponseData
        Of shape `(f, 1, 1)`, for `fit_response`.

    Raises
    ------
    DataError
        One sentence with file and column, what was expected and what to do.
    """
    table = open_table(path)
    magnitude = _one_of(table, _MAGNITUDE, _DECIBEL)
    phase = _one_of(table, _DEGREES, _RADIANS)
    cartesian = _REAL in table.names and _IMAGINARY in table.names
    if "frequency_Hz" not in table.names or cartesian == bool(magnitude and phase):
        raise data_error(
            table.path,
            f"expected the columns frequency_Hz and either {_REAL} and {_IMAGINARY} or {_MAGNITUDE} (or {_DECIBEL}) "
            f"and {_DEGREES} (or {_RADIANS}), found {', '.join(table.names)}; rename or drop columns",
            table.header_line,
        )
    shown = (_REAL, _IMAGINARY) if cartesian else (magnitude, phase)
    known = (_VARIANCE,) if _VARIANCE in table.names else ()
    values, _ = table.read(("frequency_Hz", *shown, *known))
    for name, unit in _UNITS.items():
        if name in ("frequency_Hz", *shown, *known):
            check_size(table, name, values[name], unit)
    first, second = (values[name] for name in shown)
    for name, wrong, expected in (
        ("frequency_Hz", np.diff(values["frequency_Hz"], prepend=-np.inf) <= 0, "frequencies that increase"),
        ("frequency_Hz", values["frequency_Hz"] < 0, "frequencies from 0 Hz on"),
        (_MAGNITUDE, (first < 0) & (shown[0] == _MAGNITUDE), "magnitudes that are not negative"),
        *((name, values[name] <= 0, "positive variances") for name in known),
    ):
        if np.any(wrong):
            row = int(np.argmax(wrong))
            raise data_error(table.path, f"expected {expected}; correct or sort the rows", table.line(row), name)
    if cartesian:
        response = first + 1j * second
    else:
        size = 10 ** (first / 20) if magnitude == _DECIBEL else first
        response = size * np.exp(1j * (np.deg2rad(second) if phase == _DEGREES else second))
    return ResponseData(
        values["frequency_Hz"], response[:, None, None], values[_VARIANCE][:, None, None] if known else None
    )


def _one_of(table: Table, *names: str) -> str:
    found = [name for name in names if name in table.names]
    if len(found) > 1:
        raise data_error(
            table.path, f"expected one of {' and '.join(names)}, found both; drop one", table.header_line
        )
    return found[0] if found else ""
