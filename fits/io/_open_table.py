"""From a file of any format, or an object of another library, to a table of named columns."""

import logging
import os
import warnings
import zlib
from collections.abc import Mapping
from typing import Any

import numpy as np

from fits.io._errors import AnyPath, DataError
from fits.io._read_file import MOST_CSV_BYTES, numbered, read_bytes, unpack
from fits.io._table import Table, gathered, of_frame
from fits.io.formats import FORMATS, Format

_LOG = logging.getLogger(__name__)
_CSV = "a CSV file"


def open_table(source: AnyPath | Any) -> Table:
    """Read a file, or take a pandas `DataFrame`, an xarray `Dataset` or a mapping of arrays.

    Formats are known by their first bytes and by the ending of the name, text by neither; of several tables in a text
    `runs.csv#2` or `runs.lvm#2` is the second. A `DataError` says that it cannot be read, or has no columns.
    """
    if hasattr(source, "to_dataframe"):  # xarray
        source = source.to_dataframe()
    if isinstance(source, Mapping):
        return gathered("mapping", "a mapping", [((str(name),), values, None) for name, values in source.items()])
    if not isinstance(source, str | os.PathLike):
        import pandas as pd

        if isinstance(source, pd.DataFrame):
            return of_frame("DataFrame", source)
        raise DataError(
            f"expected the name of a file, a DataFrame or a mapping of arrays, found {type(source).__name__}; "
            'give one of these, such as {"time_s": t, "voltage_V": u, "displacement_um": y}.'
        )
    shown = os.fspath(source)
    file, number = numbered(shown)
    data = read_bytes(file, _format_of(file, b"").name, MOST_CSV_BYTES)
    if data.startswith(b"\x1f\x8b") or file.lower().endswith(".gz"):
        data = unpack(data, file, MOST_CSV_BYTES)
    form = _format_of(file, data)
    if number is not None and not form.several:
        raise DataError(f"{shown}: expected {_CSV} with several tables, found {form.name}; leave out #{number}.")
    try:
        # What a library has to say of damage is said below, in one sentence.
        with np.errstate(all="ignore"), warnings.catch_warnings(action="ignore"):
            return form.open(shown, data)
    except (DataError, KeyboardInterrupt):
        raise
    except (Exception, zlib.error):  # whatever the library of a format has against its bytes
        if form.name == _CSV:
            raise
        _LOG.debug("%s: the library of this format says", shown, exc_info=True)
        raise DataError(
            f"{shown}: expected {form.name}, found one that is damaged or cut off, or a kind that cannot be read; "
            "export it again, or as CSV."
        ) from None


def _format_of(path: str, data: bytes) -> Format:
    ending = os.path.splitext(path.lower().removesuffix(".gz"))[1]
    by_start = (form for form in FORMATS.values() if form.starts and data.startswith(form.starts))
    by_ending = (form for form in FORMATS.values() if ending in form.endings)
    return next(by_start, None) or next(by_ending, FORMATS[_CSV])
