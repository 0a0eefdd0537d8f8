"""Arrays of NumPy: several by name (.npz), or a matrix (.npy)."""

import io
import zipfile
from contextlib import suppress

import numpy as np

from fits.io._read_file import refuse_large
from fits.io._table import ArrayTable, Found, Table, gathered
from fits.io.formats._base import Format, register

_NPY = b"\x93NUMPY"


def open_numpy(path: str, data: bytes) -> Table:
    """Read the arrays but those of pickled objects, which could run anything."""
    if data.startswith(_NPY):
        array = np.load(io.BytesIO(data), allow_pickle=False)
        table = gathered(path, "a NumPy file", [(("column",), array, None)])
        if array.dtype.names:
            return table
        return ArrayTable(path, {str(k): each for k, each in enumerate(table.arrays.values(), 1)}, headed=False)
    with zipfile.ZipFile(io.BytesIO(data)) as packed:
        refuse_large(path, sum(each.file_size for each in packed.infolist()))
    with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
        found = list[Found]()
        for name in arrays.files:
            with suppress(ValueError):  # of objects
                found.append(((name,), arrays[name], None))
        return gathered(path, "a NumPy file", found)


register(Format("a NumPy file", (".npz", ".npy"), (_NPY,), open_numpy))
