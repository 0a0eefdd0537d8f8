"""The tables of a sweep's TOML, and the files that it names."""

import math
import os
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

import msgspec

from fits.io._errors import DataError, shown
from fits.machining._design import nearest

_Table = TypeVar("_Table", bound=msgspec.Struct)
# Squares and products of what is larger overflow.
_LARGEST = 1e30


def read_table(table: Any, kind: type[_Table], place: str) -> _Table:
    """Read a table whose keys are the fields of a `msgspec.Struct`.

    Parameters
    ----------
    table
        What the TOML has there.
    kind
        The description of each field's `msgspec.Meta` says in words what is expected.
    place
        Where it stands; sentences begin with it.

    Raises
    ------
    DataError
        If it is no table, a key is unknown or missing, or a value is not as described.
    """
    check_keys(table, kind.__struct_fields__, place)
    required = kind.__struct_fields__[: len(kind.__struct_fields__) - len(kind.__struct_defaults__)]
    for key, hint in get_type_hints(kind, include_extras=True).items():
        if key not in table:
            if key in required:
                raise DataError(f"{place}.{key}: expected {_described(hint)}, found none; add it.")
            continue
        if hint is Any:
            continue
        value = table[key]
        try:
            if isinstance(value, float) and not math.isfinite(value):
                raise OverflowError
            msgspec.convert(value, hint)
        except (msgspec.ValidationError, OverflowError):
            raise DataError(
                f"{place}.{key}: expected {_described(hint)}, found {shown(value)}; correct it."
            ) from None
    return msgspec.convert(table, kind)


def _described(hint: Any) -> str:
    return str(hint.__metadata__[-1].description)


def check_keys(table: Any, known: Sequence[str], place: str) -> None:
    """Refuse what is no table, and keys that are not known."""
    if not isinstance(table, dict):
        raise DataError(f"{place}: expected a table, found {shown(table)}; write [{place}] and its keys below.")
    for key in table:
        if key not in known:
            raise DataError(f"{place}.{key}: expected a known key, found {shown(key)}; {nearest(key, known)}")


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
