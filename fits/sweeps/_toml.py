"""The tables of a sweep's TOML, and the files that it names."""

import math
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from fits.io._errors import DataError, shown

# Squares and products of what is larger overflow.
_LARGEST = 1e30


def number(found: Any, place: str) -> float:
    """A finite number, or a `DataError` that begins with its place."""
    try:
        value = float(found) if isinstance(found, int | float) and not isinstance(found, bool) else math.nan
    except OverflowError:
        value = math.inf
    if not math.isfinite(value):
        raise DataError(f"{place}: expected a finite number, found {shown(found)}; give one without quotes.")
    if abs(value) > _LARGEST or 0 < abs(value) < 1 / _LARGEST:
        raise DataError(f"{place}: expected 0, or {1 / _LARGEST:g} to {_LARGEST:g} in size, found {value:g}.")
    return value


def in_a_file(content: bytes, name: str, read: Callable[[Path], Any]) -> Any:
    """Read a content with what reads files; sentences name the file as the sweep does."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / os.path.basename(name)
        path.write_bytes(content)
        try:
            return read(path)
        except DataError as error:
            raise DataError(str(error).replace(str(path), name)) from None
