"""Gains of controllers as `microid control` prints them, and as it reads them again."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from operator import attrgetter
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from fits.control._tune import parameter_values
from fits.io._errors import DataError, shown
from fits.io._read_file import MOST_JSON_BYTES, parse_json, read_text
from microid import parameter_table
from microid.control import CONTROLLERS, PID, AbstractController, settings_of

GAINS = ("proportional_V_per_um", "integral_V_per_um_s", "derivative_V_s_per_um")
PID_SETTINGS = {setting.name: setting for setting in settings_of(PID)}
_Controller = TypeVar("_Controller", bound=AbstractController)


@dataclass(frozen=True)
class Given:
    """Gains that are given: of the PID controller by field, and of what is made around it by path."""

    pid: Mapping[str, float]
    others: Mapping[str, np.ndarray] = field(default_factory=dict)


def replaced(controller: _Controller, values: Mapping[str, np.ndarray]) -> _Controller:
    """A controller with other values of some fields, by path; a `DataError` says which has a wrong shape or size."""
    for row in (row for row in parameter_table(controller) if row.path in values):
        value, low, high = values[row.path], row.spec.lower, row.spec.upper
        if value.shape != tuple(row.shape):
            raise DataError(f"gains: expected {row.path} of shape {row.shape}, found {value.shape}.")
        if value.min() < low and high == math.inf:
            raise DataError(f"gains: expected {row.path} of {low:g} or more, found {value.min():g}.")
        if value.min() < low or value.max() > high:
            raise DataError(f"gains: expected {row.path} between {low:g} and {high:g}, found what is beyond.")

    def replace(path: Any, leaf: Any) -> Any:
        name = jax.tree_util.keystr(path).lstrip(".")
        return jnp.asarray(values[name]) if name in values else leaf

    return jax.tree_util.tree_map_with_path(replace, controller)


def printed_gains(controller: AbstractController, pid: PID) -> dict[str, np.ndarray]:
    """All parameters that make a controller again, by path: its own, and those of its PID controller."""
    values = parameter_values(controller)
    if isinstance(controller, PID):
        return values
    around = {f"pid.{name}": value for name, value in parameter_values(pid).items()}
    more = {name: np.asarray(attrgetter(name)(controller)) for name in controller.own if name not in values}
    return around | values | more


def read_gains(text: str) -> Given:
    """Gains from the command line: three numbers, or a file as `--json` printed it, or with `gains` alone."""
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        given = _read_file(text)
    else:
        if len(values) != len(GAINS):
            raise DataError(f"gains: expected three numbers KP,KI,KD or a file, found {len(values)}: '{text}'.")
        given = Given(dict(zip(GAINS, values, strict=True)))
    for name, value in given.pid.items():
        if not (math.isfinite(value) and value >= PID_SETTINGS[name].lower):
            raise DataError(f"gains: expected {name} of 0 or more, found {value:g}.")
    return given


def _read_file(path: str) -> Given:
    what = "KP,KI,KD or a file of gains"
    try:
        content = parse_json(read_text(path, what, MOST_JSON_BYTES), shown(path), what)
    except DataError as error:
        raise DataError(f"gains: {error}") from None
    content = content.get("gains", content) if isinstance(content, dict) else {}
    content = content if isinstance(content, dict) else {}
    prefix = "pid." if any(name.startswith("pid.") for name in content) else ""
    fields = [f"{prefix}{name}" for name in PID_SETTINGS]
    for name in GAINS:
        if f"{prefix}{name}" not in content:
            raise DataError(f"{path}: expected the key {prefix}{name} with a number, found none; add it.")
    known = {*fields, *(name for controller in CONTROLLERS.values() for name in controller.own)}
    found = {name: _numbers(path, name, value, known) for name, value in content.items()}
    for name in fields:
        if name in found and found[name].ndim:
            raise DataError(f"{path}: expected one number for {name}, found {found[name].size}.")
    pid = {name.removeprefix(prefix): float(found.pop(name)) for name in fields if name in found}
    return Given(pid, found)


def _numbers(path: str, name: str, value: Any, known: set[str]) -> np.ndarray:
    if name not in known:
        raise DataError(f"{path}: {name} is no parameter of a controller; take it out, or correct its name.")
    try:
        numbers = np.asarray(value)
    except ValueError:
        numbers = np.asarray(None)
    if numbers.dtype.kind not in "iuf" or numbers.size == 0 or not np.all(np.isfinite(numbers)):
        raise DataError(f"{path}: expected the key {name} with numbers, found {shown(value)}.")
    return numbers.astype(float)
