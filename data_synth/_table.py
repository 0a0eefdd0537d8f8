"""TOML tables into Python arguments: unknown, missing and ill-typed keys are refused by name."""

import difflib
import inspect
import math
import types
import typing
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import is_dataclass
from typing import Any

from data_synth._errors import ScenarioError

# No quantity of a stage lies beyond, in any unit; powers of numbers that do overflow.
_SMALLEST, _LARGEST = 1e-15, 1e15


def nearest(word: str, known: Iterable[str]) -> str:
    """Say which known word is meant, in words to end a sentence with, or which ones there are."""
    known = list(known)
    close = difflib.get_close_matches(word[:100], known, n=1)
    return f"did you mean '{close[0]}'?" if close else f"known are {', '.join(known)}"


def read_arguments(
    target: Callable[..., object],
    table: object,
    where: str,
    supplied: Collection[str] = (),
    optional: Collection[str] = (),
) -> dict[str, Any]:
    """Turn a table into keyword arguments of `target`, a function or a dataclass, by its annotations.

    Parameters
    ----------
    target
        Whose parameters are the keys.
    table
        What stands in the TOML file.
    where
        The place in the file, which starts each sentence of refusal.
    supplied, optional
        Parameters that are no keys, and parameters that have a default elsewhere.

    Raises
    ------
    ScenarioError
        For the first key that is unknown, missing or of the wrong type.
    """
    if not isinstance(table, dict):
        raise ScenarioError(f"{where} must be a table, got {table!r}")
    parameters = {
        name: parameter for name, parameter in inspect.signature(target).parameters.items() if name not in supplied
    }
    for key in table:
        if key not in parameters:
            raise ScenarioError(f"{where}: unknown key '{key}', {nearest(key, parameters)}")
    for name, parameter in parameters.items():
        if parameter.default is parameter.empty and name not in table and name not in optional:
            raise ScenarioError(f"{where}: key '{name}' is missing")
    hints = typing.get_type_hints(target)
    return {key: _read_value(hints[key], value, f"{where}: {key}") for key, value in table.items()}


def build(target: Callable[..., Any], table: object, where: str, **supplied: object) -> Any:
    """Call `target` with a table's keys and what is supplied; a ValueError of its own gets the place put in front."""
    arguments = read_arguments(target, table, where, supplied)
    try:
        return target(**arguments, **supplied)
    except ScenarioError:
        raise
    except ValueError as error:
        raise ScenarioError(f"{where}: {error}") from error


def _read_value(hint: Any, value: object, where: str) -> Any:
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (types.UnionType, typing.Union):  # X | None: TOML has no null, so a key that is there is an X
        return _read_value(arguments[0], value, where)
    if origin is typing.Literal:
        if value not in arguments:
            raise ScenarioError(f"{where} must be one of {', '.join(arguments)}, got {value!r}")
        return value
    if origin in (tuple, Sequence):
        if not isinstance(value, list):
            raise ScenarioError(f"{where} must be a list, got {value!r}")
        return tuple(_read_value(arguments[0], item, f"{where}[{k}]") for k, item in enumerate(value))
    if hasattr(hint, "from_table"):
        return hint.from_table(value, where)
    if is_dataclass(hint):
        return build(typing.cast(Callable[..., Any], hint), value, where)
    if hint is float and type(value) is int:
        return float(value)
    if type(value) is not hint:  # not isinstance: true is an int to Python, but not to us
        words = {float: "a number", int: "a whole number", str: "a text", bool: "true or false"}
        raise ScenarioError(f"{where} must be {words[hint]}, got {value!r}")
    if hint is float:
        size = abs(typing.cast(float, value))
        if not math.isfinite(size):
            raise ScenarioError(f"{where} must be finite, got {value}")
        if size > _LARGEST or 0 < size < _SMALLEST:
            raise ScenarioError(f"{where} must be 0, or {_SMALLEST:g} to {_LARGEST:g} in size, got {value}")
    return value
