"""JSON: named arrays, a matrix, or an object for each sample."""

from collections.abc import Iterator
from contextlib import suppress
from typing import Any

import numpy as np

from fits.io._read_file import MOST_JSON_BYTES, parse_json, refuse_large
from fits.io._table import ArrayTable, Found, Table, data_error, gathered
from fits.io.formats._base import Format, register

_WHAT = "a JSON file"


def open_json(path: str, data: bytes) -> Table:
    """Read all arrays of numbers of one length; null is a missing number. Columns of a matrix alone are numbered."""
    refuse_large(path, len(data), MOST_JSON_BYTES)
    content = parse_json(data.decode("utf-8-sig"), path, "a table")
    if isinstance(content, dict) and str(content.get("schema")).startswith("microid."):
        what = "expected a header and rows of numbers, found JSON; name a table (microid info shows a model file)"
        raise data_error(path, what, "line 1")
    found = list(_found((), content))
    if len(found) == 1 and found[0][1].ndim == 2:
        columns = gathered(path, _WHAT, [(("column",), *found[0][1:])]).arrays.values()
        return ArrayTable(path, {str(k): each for k, each in enumerate(columns, 1)}, headed=False)
    return gathered(path, _WHAT, found)


def _found(name: tuple[str, ...], value: Any) -> Iterator[Found]:
    if isinstance(value, list) and value and all(isinstance(row, dict) for row in value):
        value = {key: [row.get(key) for row in value] for key in value[0]}
    if isinstance(value, dict):
        heads, rows = value.get("columns"), value.get("data")
        if isinstance(heads, list) and isinstance(rows, list) and all(isinstance(head, str) for head in heads):
            # As pandas writes tables with `orient="split"`.
            value = dict(zip(heads, zip(*rows, strict=False), strict=False))
        for key, each in value.items():
            yield from _found((*name, key), each)
    elif isinstance(value, list | tuple):
        for kind in (float, str):
            # What is no rectangle is no array.
            with suppress(ValueError, TypeError):
                yield name or ("column",), np.array(value, dtype=kind), None
                break


register(Format(_WHAT, (".json",), (), open_json))
