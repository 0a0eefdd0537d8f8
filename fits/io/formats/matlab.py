"""MATLAB files: up to version 7 by SciPy, from 7.3 on as HDF5; arrays, structures, and the captures of dSPACE."""

import io
import math
import struct
import zlib
from collections.abc import Iterator
from typing import Any

import numpy as np

from fits.io._extras import need
from fits.io._read_file import refuse_large
from fits.io._table import Found, Table, gathered
from fits.io.formats._base import Format, register

# Structures within structures that are looked into, and elements within elements.
_DEEPEST, _NESTED = 9, 16
# How a signal is written as a structure: its name, its values and its unit.
_SIGNAL = (("Name", "Data", "Unit"), ("label", "values", "unit"), ("name", "data", "unit"))
# Bytes of a number of each type of data; 16 to 18 are characters. Matrices and what is packed have their own types.
_BYTES = {1: 1, 2: 1, 3: 2, 4: 2, 5: 4, 6: 4, 7: 4, 9: 8, 12: 8, 13: 8, 16: 1, 17: 2, 18: 4}
_MATRIX, _PACKED = 14, 15
# Classes of matrices.
_CELL, _STRUCT, _TEXT, _NUMBERS = 1, 2, 4, range(6, 16)

_Element = tuple[int, bytes]


class _OfMatlabAlone(ValueError):
    """Tables, objects, functions and sparse matrices."""


def sound_variables(path: str, data: bytes) -> list[str]:
    """Names of the variables of version 5 that can be read: numbers, texts, structures and cell arrays.

    SciPy takes for granted that their elements fit into each other. A ValueError says what does not, a `DataError`
    that the file unpacks to too much.
    """
    order = "<" if data[126:128] == b"IM" else ">"
    size, names = 0, []
    for kind, content in _elements(data[128:], order):
        if kind == _PACKED:
            # No more is unpacked than is read, and the sum at its end is compared.
            unpack = zlib.decompressobj()
            content = unpack.decompress(content, 1_000_000_000)
            refuse_large(path, len(content) + len(unpack.unconsumed_tail))
            if not unpack.eof:
                raise ValueError("packed data are cut")
            kind, content = next(_elements(content, order), (0, b""))
        size += len(content)
        refuse_large(path, size)
        if kind != _MATRIX:
            raise ValueError("a variable is no matrix")
        try:
            names.append(_check_matrix(content, order, 0))
        except _OfMatlabAlone:
            continue
    return names


def _elements(data: bytes, order: str) -> Iterator[_Element]:
    """Types and contents of what stands one behind the other."""
    at = 0
    while at < len(data):
        if at + 8 > len(data):
            raise ValueError("an element is cut")
        kind, size = struct.unpack_from(f"{order}II", data, at)
        begin = at + 8
        if kind >> 16:  # up to four bytes stand within the tag
            kind, size, begin = kind & 0xFFFF, kind >> 16, at + 4
            at += 8
        else:
            at = begin + size + (0 if kind == _PACKED else -size % 8)
        if begin + size > len(data) or (begin == at - 4 and size > 4) or kind not in (*_BYTES, _MATRIX, _PACKED):
            raise ValueError("an element is cut or of unknown type")
        yield kind, data[begin : begin + size]


def _check_matrix(data: bytes, order: str, depth: int) -> str:
    """Check a matrix and what is in it; its name comes back."""
    if not data:
        return ""  # an empty one within a structure
    flags, *parts = _elements(data, order)
    if flags[0] != 6 or len(flags[1]) != 8 or depth > _NESTED:
        raise ValueError("a matrix has no flags")
    kind = struct.unpack_from(f"{order}I", flags[1])[0]
    complex_, kind = bool(kind & 0x800), kind & 0xFF
    if kind not in (_CELL, _STRUCT, _TEXT, *_NUMBERS):
        raise _OfMatlabAlone("tables and objects are not read")
    kinds, sizes = [each for each, _ in parts[:2]], parts[0][1] if parts else b""
    if kinds not in ([5, 1], [5, 16]) or len(sizes) % 4 or len(sizes) < 8:
        raise ValueError("a matrix has no size or name")
    shape = struct.unpack(f"{order}{len(sizes) // 4}i", sizes)
    count, rest, name = math.prod(shape), parts[2:], parts[1][1].decode("latin-1")
    if min(shape) < 0:
        raise ValueError("a matrix has a negative size")
    if kind in (_TEXT, *_NUMBERS):
        # A character of a text in UTF-8 has a byte or more.
        fits = [
            part in _BYTES and (len(content) == count * _BYTES[part] or (part == 16 and len(content) >= count))
            for part, content in rest
        ]
        if len(fits) != 1 + complex_ or not all(fits):
            raise ValueError("a matrix holds more or less numbers than its size says")
        return name
    if kind == _STRUCT:
        width = struct.unpack(f"{order}i", rest[0][1])[0] if rest and len(rest[0][1]) == 4 else 0
        if len(rest) < 2 or width < 1 or len(rest[1][1]) % width:
            raise ValueError("a structure has no names")
        count *= len(rest[1][1]) // width
        rest = rest[2:]
    if len(rest) != count:
        raise ValueError("a structure or cell array has more or less parts than its size says")
    for part, content in rest:
        if part != _MATRIX:
            raise ValueError("a part is no matrix")
        _check_matrix(content, order, depth + 1)
    return name


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
