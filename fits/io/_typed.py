"""Tables of TOML and JSON as typed structs; the first fault is a sentence: place, what was expected, what to do."""

import math
import types
from collections.abc import Sequence
from difflib import get_close_matches
from typing import Annotated, Any, TypeVar, Union, get_args, get_origin

import msgspec

from fits.io._errors import DataError, shown

_Table = TypeVar("_Table", bound=msgspec.Struct)
# What is expected of a value whose field has no description of its own, and what to do.
_EXPECTED = {
    float: ("a finite number", "give one without quotes"),
    int: ("a whole number", "give one without quotes or a point"),
    bool: ("true or false", "give one without quotes"),
    str: ("a text", "put it in quotes"),
    list: ("a list", "put what is in it in brackets"),
}
_OTHER = "a value of another kind", "correct it"


def typed(table: Any, kind: type[_Table], place: str = "") -> _Table:
    """Read a table whose keys are the fields of a struct, nested ones and lists of them included.

    The description of a field's `msgspec.Meta`, if any, says what is expected. A `DataError`, which begins with the
    place such as `geometry.t2.value`, refuses what is not as the struct says, and numbers that are not finite.
    """
    _check(table, kind, place)
    return msgspec.convert(table, kind)


def check_keys(table: Any, known: Sequence[str], place: str) -> None:
    """Refuse what is no table, and keys that are not known."""
    if not isinstance(table, dict):
        keys = ", ".join(known)
        raise DataError(
            f"{place}: expected a table of {keys}, found {shown(table)}; write [{place}] and its keys below."
        )
    for key in table:
        if key not in known:
            word = shown(key)
            raise DataError(
                f"{_within(place, word[1:-1])}: expected a known key, found {word}; {nearest(key, known)}"
            )


def nearest(name: str, known: Sequence[str]) -> str:
    """Say what a name may have been meant for."""
    close = get_close_matches(name, known, n=1, cutoff=0.5)
    return f"did you mean {close[0]}?" if close else f"use one of {', '.join(known)}."


def _within(place: str, key: str) -> str:
    return f"{place}.{key}" if place else key


def _described(hint: Any) -> str:
    metas = get_args(hint)[1:] if get_origin(hint) is Annotated else ()
    return next((meta.description for meta in metas if meta.description), "")


def _check(value: Any, hint: Any, place: str) -> None:
    if get_origin(hint) in (Union, types.UnionType) and not _described(hint):
        # Neither TOML nor our JSON has a null: a key that is there has a value.
        hint = get_args(hint)[0]
    base = get_args(hint)[0] if get_origin(hint) is Annotated else hint
    kind = get_origin(base) or base
    if isinstance(kind, type) and issubclass(kind, msgspec.Struct):
        fields = {field.encode_name: field for field in msgspec.structs.fields(kind)}
        check_keys(value, list(fields), place)
        for key, field in fields.items():
            if key in value:
                _check(value[key], field.type, _within(place, key))
            elif field.required:
                expected = _described(field.type) or "this key"
                raise DataError(f"{_within(place, key)}: expected {expected}, found none; add it.")
    elif kind is list and isinstance(value, list) and not _described(hint):
        for k, item in enumerate(value):
            _check(item, get_args(base)[0], f"{place}[{k}]")
    elif base is not Any:
        try:
            msgspec.convert(value, hint)
            fits = not isinstance(value, float) or math.isfinite(value)
        except (msgspec.ValidationError, OverflowError):
            fits = False
        if not fits:
            expected, remedy = (_described(hint), "correct it") if _described(hint) else _EXPECTED.get(kind, _OTHER)
            raise DataError(f"{place}: expected {expected}, found {shown(value)}; {remedy}.")
