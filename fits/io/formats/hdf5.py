"""HDF5: data sets, with their units as attributes."""

import io
from collections.abc import Iterator
from typing import Any

from fits.io._extras import need
from fits.io._read_file import refuse_large
from fits.io._table import Found, Table, gathered
from fits.io.formats._base import Format, register


def open_hdf5(path: str, data: bytes) -> Table:
    """Read all data sets of numbers of one length."""
    h5py = need("h5py", "io")
    with h5py.File(io.BytesIO(data), "r") as file:
        return gathered(path, "an HDF5 file", list(_found(path, file, h5py)))


def _found(path: str, file: Any, h5py: Any) -> Iterator[Found]:
    names: list[str] = []
    file.visit(names.append)  # each object once, in the order of names
    size = 0
    for name in names:
        each, parts = file[name], tuple(name.split("/"))
        if not isinstance(each, h5py.Dataset):
            continue
        size += each.size * each.dtype.itemsize if each.shape else 0
        refuse_large(path, size)
        if each.shape and (each.dtype.kind in "iufSO" or each.dtype.names):
            unit = next((each.attrs[key] for key in ("units", "unit", "Unit", "Units") if key in each.attrs), None)
            yield (
                parts,
                each[()],
                unit.decode() if isinstance(unit, bytes) else unit if isinstance(unit, str) else None,
            )


register(Format("an HDF5 file", (".h5", ".hdf5", ".hdf", ".nxs"), (b"\x89HDF\r\n\x1a\n",), open_hdf5))
