"""MATLAB files: up to version 7 by SciPy, from 7.3 on as HDF5; arrays, structures, and the captures of dSPACE."""

import io
from collections.abc import Iterator
from typing import Any

import numpy as np

from fits.io._table import Found, Table, gathered
from fits.io.formats._base import Format, register
from fits.io.formats._mat_elements import sound_variables
from fits.io.formats.hdf5 import open_hdf5

# How a signal is written as a structure: its name, its values and its unit.
_SIGNAL = (("Name", "Data", "Unit"), ("label", "values", "unit"), ("name", "data", "unit"))


def open_matlab(path: str, data: bytes) -> Table:
    """Read all arrays of numbers of one length, also within structures."""
    from scipy import io as scipy_io

    if data[512:520] == b"\x89HDF\r\n\x1a\n":  # from version 7.3 on, behind MATLAB's own block
        return open_hdf5(path, data)
    # Files of version 4 begin with a number below 5,000.
    names = None if 0 in data[:4] else sound_variables(path, data)
    variables = scipy_io.loadmat(io.BytesIO(data), simplify_cells=True, variable_names=names)
    found = [each for name, value in variables.items() if name[:2] != "__" for each in _found((name,), value)]
    return gathered(path, "a MATLAB file", found)


def _found(name: tuple[str, ...], value: Any, depth: int = 0) -> Iterator[Found]:
    if depth > 8:
        return
    if isinstance(value, dict):
        for called, values, unit in _SIGNAL:
            if isinstance(value.get(called), str) and values in value:
                yield (*name, value[called]), value[values], value[unit] if isinstance(value.get(unit), str) else None
                return
        for key, each in value.items():
            # Of a structure that holds values under a general name the structure's own says more.
            general = key.lower() in ("data", "value", "values")
            yield from _found(name if general else (*name, key), each, depth + 1)
    elif isinstance(value, list) or (isinstance(value, np.ndarray) and value.dtype == object):
        for k, each in enumerate(np.ravel(np.asarray(value, dtype=object)) if not isinstance(value, list) else value):
            yield from _found((*name[:-1], f"{name[-1]}_{k + 1}"), each, depth + 1)
    elif isinstance(value, np.ndarray):
        yield name, value, None


register(Format("a MATLAB file", (".mat",), (b"MATLAB 5.0", b"MATLAB 7.3"), open_matlab))
