"""MATLAB files: up to version 7 by SciPy, from 7.3 on as HDF5; arrays, structures, and the captures of dSPACE."""

import io
from collections.abc import Iterator
from typing import Any

import numpy as np

from fits.io._late import need
from fits.io._read_file import refuse_large
from fits.io._table import Found, Table, gathered
from fits.io.formats._base import Format, register
from fits.io.formats._mat_elements import sound_variables

# Structures within structures that are looked into.
_DEEPEST = 9
# How a signal is written as a structure: its name, its values and its unit.
_SIGNAL = (("Name", "Data", "Unit"), ("label", "values", "unit"), ("name", "data", "unit"))


def open_matlab(path: str, data: bytes) -> Table:
    """Read all arrays of numbers of one length, also within structures."""
    from scipy import io as scipy_io

    if data[512:520] == b"\x89HDF\r\n\x1a\n":  # from version 7.3 on, behind MATLAB's own block
        h5py = need("h5py", "io")
        with h5py.File(io.BytesIO(data), "r") as file:
            variables = {name: each for name, each in _unfold(path, file, h5py, [0]).items() if name[0] != "#"}
            return gathered(path, "a MATLAB file", list(_found((), variables)))
    # Files of version 4 begin with a number below 5,000.
    names = None if 0 in data[:4] else sound_variables(path, data)
    variables = scipy_io.loadmat(io.BytesIO(data), simplify_cells=True, variable_names=names)
    variables = {name: value for name, value in variables.items() if name[:2] != "__"}
    return gathered(path, "a MATLAB file", list(_found((), variables)))


def _unfold(path: str, each: Any, h5py: Any, size: list[int], depth: int = 0) -> Any:
    """What SciPy makes of a file of version 5, of one of version 7.3: structures, lists, texts and arrays."""
    if depth > _DEEPEST:
        return None
    if isinstance(each, h5py.Group):
        parts = {name: _unfold(path, each[name], h5py, size, depth + 1) for name in each if name != "#refs#"}
        # The fields of an array of structures are lists, which MATLAB does not call cells.
        listed = [name for name in parts if isinstance(parts[name], list) and "MATLAB_class" not in each[name].attrs]
        if listed and len(listed) == len(parts):
            return [dict(zip(parts, fields, strict=False)) for fields in zip(*parts.values(), strict=False)]
        return parts
    size[0] += each.size * each.dtype.itemsize if each.shape else 0
    refuse_large(path, size[0])
    if each.attrs.get("MATLAB_class") == b"char":
        return "".join(map(chr, np.ravel(each[()])))
    if h5py.check_ref_dtype(each.dtype) is not None:
        return [_unfold(path, each.file[one], h5py, size, depth + 1) for one in np.ravel(each[()]) if one]
    return each[()] if each.shape and each.dtype.kind in "iuf" else None


def _found(name: tuple[str, ...], value: Any, depth: int = 0) -> Iterator[Found]:
    if depth > _DEEPEST:
        return
    if isinstance(value, dict):
        for called, values, unit in _SIGNAL:
            if isinstance(value.get(called), str) and values in value:
                yield (*name, value[called]), value[values], value[unit] if isinstance(value.get(unit), str) else None
                return
        for key, each in value.items():
            # Of a structure that holds values under a general name the structure's own says more.
            general = name and key.lower() in ("data", "value", "values")
            yield from _found(name if general else (*name, key), each, depth + 1)
    elif isinstance(value, list) or (isinstance(value, np.ndarray) and value.dtype == object):
        for k, each in enumerate(np.ravel(np.asarray(value, dtype=object)) if not isinstance(value, list) else value):
            yield from _found((*name[:-1], f"{name[-1]}_{k + 1}"), each, depth + 1)
    elif isinstance(value, np.ndarray):
        yield name, value, None


register(Format("a MATLAB file", (".mat",), (b"MATLAB 5.0", b"MATLAB 7.3"), open_matlab))
