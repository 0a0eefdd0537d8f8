"""Reading a file that a user names: regular files only, of bounded size, and JSON and TOML of bounded depth."""

import gzip
import io
import json
import logging
import math
import os
import re
import stat
import tomllib
import zlib
from typing import Any

from fits.io._errors import AnyPath, DataError, reason_of, shown

_LOG = logging.getLogger(__name__)
# Each is many times what real files need, and fits in the memory of a small computer.
MOST_CSV_BYTES = 512_000_000
MOST_JSON_BYTES = 64_000_000
MOST_TOML_BYTES = 1_000_000
MOST_DEPTH = 32
_LARGEST_INTEGER = 2**63 - 1


def numbered(path: str) -> tuple[str, int | None]:
    """Tell a file from the number of a table in it, as in `runs.csv#2`; a file of that very name comes first."""
    found = re.fullmatch(r"(.+)#([1-9]\d{0,3})", path)
    return (found[1], int(found[2])) if found and not os.path.lexists(path) else (path, None)


def read_bytes(path: AnyPath, what: str, most: int) -> bytes:
    """Read `what` is expected at a path, such as `a CSV file`; a `DataError` if it cannot be, or is too large."""
    name = os.fspath(path)
    if not name:
        raise DataError(f"expected the name of {what}, found an empty one; give one.")
    try:
        mode = os.stat(path).st_mode
        if stat.S_ISDIR(mode):
            raise DataError(f"{name}: expected {what}, found a folder; name a file in it.")
        if not stat.S_ISREG(mode):
            # Reading these may wait, or go on, for ever.
            raise DataError(f"{name}: expected {what}, found a device or a pipe; name a regular file.")
        with open(path, "rb") as file:
            data = _bounded(file, name, most)
    except DataError:
        raise
    except (FileNotFoundError, NotADirectoryError):
        raise DataError(f"{name}: no such file; check the name and the folder.") from None
    except (OSError, ValueError) as error:
        raise DataError(f"{name}: cannot be read ({reason_of(error)}); check the name and the permissions.") from None
    _LOG.debug("read %s, %d bytes", name, len(data))
    return data


def read_text(path: AnyPath, what: str, most: int) -> str:
    """Read a file of UTF-8 text, with or without a byte-order mark; arguments and errors as of `read_bytes`.

    JSON in place of TOML is refused as such, however large it is.
    """
    data = read_bytes(path, what, max(most, MOST_JSON_BYTES))
    if most == MOST_TOML_BYTES and data.lstrip().startswith(b"{"):
        found = "found JSON; name another file (microid info shows a model file)"
        raise DataError(f"{os.fspath(path)}: expected {what}, {found}.")
    refuse_large(os.fspath(path), len(data), most)
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise DataError(f"{os.fspath(path)}: expected {what}, found no UTF-8 text; name another file.") from None


def unpack(data: bytes, name: str, most: int) -> bytes:
    """Unpack gzip data of a file; a `DataError` says that they are damaged, or more than `most` bytes."""
    try:
        # A few kilobytes may unpack to gigabytes, so no more is unpacked than is read.
        with gzip.GzipFile(fileobj=io.BytesIO(data)) as file:
            return _bounded(file, name, most)
    except DataError:
        raise
    except (OSError, EOFError, zlib.error) as error:
        what = str(error).rstrip(".")
        raise DataError(f"{name}: expected whole gzip data, found damage ({what}); copy or pack it again.") from None


def parse_json(text: str, place: str, what: str) -> Any:
    """Read JSON text, which is to be such as `a model file`; a `DataError` begins with the place.

    It says that this is not JSON, that a key stands twice, or what later steps could not work with.
    """

    def once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        if len(dict(pairs)) < len(pairs):
            raise json.JSONDecodeError("a key stands twice", "", 0)
        return dict(pairs)

    def refuse(name: str) -> None:
        raise json.JSONDecodeError(f"{name} is not JSON", "", 0)

    try:
        found = json.loads(text, object_pairs_hook=once, parse_constant=refuse)
    except (ValueError, RecursionError) as error:
        if text.strip() and not text.lstrip().startswith(("{", "[")):
            found = "found a table or another text; name such a file (microid inspect shows a table)"
            raise DataError(f"{place}: expected {what} in JSON, {found}.") from None
        raise DataError(
            f"{place}: expected {what} in JSON, found a broken or cut one ({_why(error)}); restore the file, or have "
            "it written again."
        ) from None
    _check(found, place, finite=True)
    return found


def parse_toml(text: str, place: str) -> dict[str, Any]:
    """Read TOML text; a `DataError`, which begins with the place, says why that cannot be."""
    try:
        found = tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        what = f"expected TOML, found a mistake: {_why(error)}; correct it, or name another file."
        raise DataError(f"{place}: {what}") from None
    _check(found, place, finite=False)
    return found


def _why(error: ValueError | RecursionError) -> str:
    if isinstance(error, RecursionError):
        return f"more than {MOST_DEPTH} nested levels"
    if isinstance(error, json.JSONDecodeError):
        begins = "it is empty" if error.msg == "Expecting value" else error.msg
        return f"{error.msg}, line {error.lineno}" if error.pos else begins
    # All else comes from Python's `int`, and is for programmers.
    toml = isinstance(error, tomllib.TOMLDecodeError)
    return str(error).rstrip(".") if toml else "an integer of thousands of digits"


def _check(value: Any, place: str, finite: bool, path: str = "", depth: int = 0) -> None:
    """Refuse what later steps could not work with: deep nests, enormous numbers, halves of characters."""
    if depth > MOST_DEPTH:
        raise DataError(f"{place}: expected up to {MOST_DEPTH} nested levels, found more; flatten it.")
    listed = isinstance(value, list)
    for key, item in enumerate(value) if listed else value.items() if isinstance(value, dict) else ():
        wrong = _fault(item, finite) or _fault(key, finite)
        if wrong or isinstance(item, dict | list):
            name = f"{path}[{key}]" if listed else f"{path}.{key}".lstrip(".")
            if wrong:
                raise DataError(f"{place}: {shown(name)[1:-1]}: expected {wrong}; correct it.")
            _check(item, place, finite, name[:200], depth + 1)


def _fault(item: Any, finite: bool) -> str:
    """What is expected instead of a single value or key, nothing if it is fine."""
    if isinstance(item, float):
        return "" if not finite or math.isfinite(item) else "a number that fits in 64 bits, found a larger one"
    if isinstance(item, int):
        return "" if abs(item) <= _LARGEST_INTEGER else "an integer of up to 64 bits, found an enormous number"
    if isinstance(item, str) and not item.isascii():
        try:
            item.encode()
        except UnicodeEncodeError:
            return "whole characters, found half of one"
    return ""


def _bounded(file: Any, name: str, most: int) -> bytes:
    pieces, size = [], 0
    while piece := file.read(1 << 20):
        pieces.append(piece)
        size += len(piece)
        refuse_large(name, size, most)
    return b"".join(pieces)


def refuse_large(path: str, size: int, most: int = MOST_CSV_BYTES) -> None:
    """Refuse more bytes than are read of a file, or unpacked from it."""
    if size > most:
        raise DataError(
            f"{path}: expected at most {most / 1e6:,.0f} MB, unpacked if it is packed, found more; split the file or "
            "name another."
        )
