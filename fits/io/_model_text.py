"""Model files as JSON, before anything is made of what they hold."""

import hashlib
import json
from collections.abc import Mapping
from typing import Any

from fits.io._errors import DataError, shown
from fits.io._read_file import MOST_JSON_BYTES, parse_json, read_text

_FAMILY = "microid.model/"
SCHEMA = f"{_FAMILY}1"
_PARTS = ("schema", "sha256", "written_by", "model", "uncertainty", "fit")


def read_model_text(name: str) -> dict[str, Any]:
    """Read the JSON of a model file; a `DataError` if it is another file, of another version, or was changed."""
    what = "a model file"
    content = parse_json(read_text(name, what, MOST_JSON_BYTES), name, what)
    schema = content.get("schema") if isinstance(content, dict) else None
    if not isinstance(schema, str) or not schema.startswith(_FAMILY):
        if str(schema).startswith("microid.diagnosis/"):
            what = "the answer of a diagnosis; name baseline.json or extended.json beside it"
            raise DataError(f"{name}: expected a model, found {what}.")
        raise DataError(f"{name}: expected a model written by 'microid fit', found other JSON; name such a file.")
    if schema != SCHEMA:
        raise DataError(
            f"{name}: expected the format {SCHEMA}, found {shown(schema)}; "
            "read it with the version of microid that wrote it, or fit again."
        )
    typed = isinstance(content.get("written_by"), str) and isinstance(content.get("fit"), dict)
    if set(content) != set(_PARTS) or not typed:
        raise DataError(f"{name}: expected the keys {', '.join(_PARTS)}; write the file again with 'microid fit'.")
    if content["sha256"] != hash_of(content):
        raise DataError(
            f"{name}: the content does not match its sha256, so it was changed after it was written; "
            "restore the file, or write it again with 'microid fit'."
        )
    return content


def hash_of(content: Mapping[str, Any]) -> str:
    """What a model file says of itself under `sha256`."""
    rest = {key: value for key, value in content.items() if key != "sha256"}
    text = json.dumps(rest, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode("ascii")).hexdigest()


def pretty(value: Any, indent: str = "") -> str:
    """Write objects that hold objects over several lines, and arrays of numbers on one."""
    inner = indent + " "
    nested = isinstance(value, dict) and any(isinstance(item, dict | list) for item in value.values())
    if nested and "unit" not in value:
        items = [f"{inner}{json.dumps(key)}: {pretty(item, inner)}" for key, item in value.items()]
        return "{\n" + ",\n".join(items) + f"\n{indent}}}"
    if isinstance(value, list) and any(isinstance(item, dict | str) for item in value):
        return "[\n" + ",\n".join(inner + pretty(item, inner) for item in value) + f"\n{indent}]"
    return json.dumps(value, allow_nan=False)
