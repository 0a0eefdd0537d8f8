"""Reading the TOML of a scenario: a regular file of bounded size, of bounded depth."""

import os
import stat
import tomllib
from typing import Any

from data_synth._errors import ScenarioError

_MOST_BYTES, _MOST_DEPTH, _LARGEST_INTEGER = 1_000_000, 32, 2**63 - 1


def read_text(file: str) -> str:
    """Read a file of up to 1 MB of UTF-8 text.

    Raises
    ------
    ScenarioError
        If there is none, or it is a folder, a device or a pipe, larger, or no UTF-8 text.
    """
    try:
        if not stat.S_ISREG(os.stat(file).st_mode):
            raise ScenarioError(f"{file}: cannot be read: it is a folder, a device or a pipe; name a regular file")
        with open(file, "rb") as opened:
            data = opened.read(_MOST_BYTES + 1)
    except (OSError, ValueError) as error:
        if isinstance(error, ScenarioError):
            raise
        reason = error.strerror if isinstance(error, OSError) else error
        raise ScenarioError(f"{file}: cannot be read: {reason}") from error
    if len(data) > _MOST_BYTES:
        raise ScenarioError(f"{file}: cannot be read: it has more than the {_MOST_BYTES // 10**6} MB that are read")
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError as error:
        raise ScenarioError(f"{file}: cannot be read: not UTF-8 text") from error


def parse_toml(text: str, file: str) -> dict[str, Any]:
    """Read TOML text.

    Raises
    ------
    ScenarioError
        If it is no TOML, nests more than 32 deep, or holds an integer beyond 64 bits.
    """
    try:
        table = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ScenarioError(f"{file}: not valid TOML: {error}") from error
    except ValueError:  # from Python's `int`
        raise ScenarioError(f"{file}: not valid TOML: an integer of thousands of digits") from None
    except RecursionError:
        raise ScenarioError(f"{file}: not valid TOML: more than {_MOST_DEPTH} nested levels") from None
    left: list[tuple[Any, int]] = [(table, 0)]
    while left:
        value, depth = left.pop()
        if depth > _MOST_DEPTH:
            raise ScenarioError(f"{file}: not valid TOML: more than {_MOST_DEPTH} nested levels")
        if isinstance(value, dict | list):
            left += [(item, depth + 1) for item in (value if isinstance(value, list) else value.values())]
        elif isinstance(value, int) and abs(value) > _LARGEST_INTEGER:
            raise ScenarioError(f"{file}: an integer must fit in 64 bits, got an enormous one")
    return table
