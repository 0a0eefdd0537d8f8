"""What a sweep's folder says of itself."""

import os
from pathlib import Path
from typing import Any

from fits.io._errors import DataError
from fits.io._read_file import MOST_JSON_BYTES, parse_json, read_text

SCHEMA = "microid.sweep.results/1"
ABOUT = "about.json"
_KEYS: dict[str, type] = {
    "kind": str,
    "rows": int,
    "chunk_rows": int,
    "chunks": int,
    "parameters": list,
    "outputs": list,
    "digest": str,
    "versions": dict,
}


def about_of(folder: str | os.PathLike[str]) -> dict[str, Any]:
    """Read what is known of a sweep; a `DataError` says why it cannot be read."""
    shown = os.fspath(folder)
    if not (Path(folder) / ABOUT).exists():
        raise DataError(f"{shown}: there is no sweep in this folder; give what --out named.")
    try:
        what = "what is known of a sweep"
        about = parse_json(read_text(Path(folder) / ABOUT, what, MOST_JSON_BYTES), ABOUT, what)
    except DataError as error:
        raise DataError(f"{shown}: {ABOUT} is broken ({error}); run the sweep again in another folder.") from None
    if not isinstance(about, dict) or about.get("schema") != SCHEMA:
        raise DataError(f"{shown}: expected results of the format {SCHEMA}; run the sweep again in another folder.")
    for key, kind in _KEYS.items():
        if not isinstance(about.get(key), kind):
            raise DataError(f"{shown}: {ABOUT} is broken (no {key}); run the sweep again in another folder.")
    return about
