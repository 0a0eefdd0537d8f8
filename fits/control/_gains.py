"""Gains of controllers as `microid control` prints them, and as it reads them again."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from fits.control._tune import parameter_values
from fits.io._errors import DataError, shown
from fits.io._read_file import MOST_JSON_BYTES, parse_json, read_text
from microid import PID, AbstractController, ResonantPID, parameter_table

GAINS = ("proportional_V_per_um", "integral_V_per_um_s", "derivative_V_s_per_um")
_WEIGHTS = ("reference_weight", "derivative_weight")
_PID = (*GAINS, "filter_s", *_WEIGHTS)
RESONATORS = ("frequency_Hz", "resonant_V_per_um_s", "lead_deg")
_NETWORK = tuple(f"network.{side}_{what}" for side in ("hidden", "output") for what in ("weight", "threshold"))
# What stands around the PID controller, by the kind of controller.
_OWN: dict[str, tuple[str, ...]] = {
    "pid": (),
    "resonant": RESONATORS,
    "bp-pid": (*_NETWORK, "learning_rate_per_um2", "momentum", "filter_s"),
    "cmac-pid": ("learning_rate",),
}
_Controller = TypeVar("_Controller", bound=AbstractController)


@dataclass(frozen=True)
class Given:
    """Gains that are given.

    Attributes
    ----------
    pid
        Of the PID controller, by field.
    others
        Of what stands around it, by path; empty where only three numbers were given.
    """

    pid: Mapping[str, float]
    others: Mapping[str, np.ndarray] = field(default_factory=dict)

    def make_pid(self, interval_s: float) -> PID:
        """The PID controller, without limits."""
        return PID(**{name: jnp.asarray(x) for name, x in self.pid.items()}, interval_s=jnp.asarray(interval_s))

    def resonators(self) -> tuple[np.ndarray, ...] | None:
        """Frequencies, gains and leads, shape `(h,)` each; None where none are given.

        Raises
        ------
        DataError
            If not all of them are given, or their numbers differ.
        """
        found = [np.atleast_1d(self.others[name]) for name in RESONATORS if name in self.others]
        if not found:
            return None
        if len(found) < len(RESONATORS) or len({one.shape for one in found}) > 1 or found[0].ndim != 1:
            raise DataError(
                f"--gains: expected {', '.join(RESONATORS)} with as many numbers each; state all or none."
            )
        if np.any(found[1] < 0):
            raise DataError(f"--gains: expected {RESONATORS[1]} of 0 or more, found {found[1].min():g}.")
        return tuple(found)

    def put_into(self, kind: str, controller: _Controller) -> _Controller:
        """Replace the parameters of a controller, but not of the PID controller within, by those that are given.

        Raises
        ------
        DataError
            If one has another shape, or is beyond its bounds.
        """
        mine = {name: x for name, x in self.others.items() if name in _OWN[kind]}
        for row in parameter_table(controller):
            if row.path not in mine:
                continue
            value, low, high = mine[row.path], row.spec.lower, row.spec.upper
            if value.shape != tuple(row.shape):
                raise DataError(f"--gains: expected {row.path} of shape {row.shape}, found {value.shape}.")
            if value.min() < low or value.max() > high:
                raise DataError(f"--gains: expected {row.path} between {low:g} and {high:g}, found what is beyond.")

        def replaced(path: Any, leaf: Any) -> Any:
            name = jax.tree_util.keystr(path).lstrip(".")
            return jnp.asarray(mine[name]) if name in mine else leaf

        return jax.tree_util.tree_map_with_path(replaced, controller)


def printed_gains(controller: AbstractController, pid: PID) -> dict[str, np.ndarray]:
    """All that makes a controller again, by path: its parameters, its resonators, and the PID controller it began as.

    Parameters
    ----------
    controller, pid
        The controller, and the PID controller it is or was made around.
    """
    values = parameter_values(controller)
    if isinstance(controller, PID):
        return values
    around = {f"pid.{name}": value for name, value in parameter_values(pid).items()}
    if isinstance(controller, ResonantPID):
        values |= {name: np.asarray(getattr(controller, name)) for name in RESONATORS}
    return around | values


def read_gains(text: str) -> Given:
    """Gains from the command line, or from a JSON file.

    Parameters
    ----------
    text
        Three numbers, or the name of a file as `--json` printed it, or with `gains` alone.

    Raises
    ------
    DataError
        If it is neither, or a value is missing, unknown, negative or no number.
    """
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) == len(GAINS):
        given = Given(dict(zip(GAINS, values, strict=True)))
    elif values:
        raise DataError(f"--gains: expected three numbers KP,KI,KD or a file, found {len(values)}: '{text}'.")
    else:
        given = _read_file(text)
    for name, value in given.pid.items():
        if not (math.isfinite(value) and (value >= 0 or name in _WEIGHTS)):
            raise DataError(f"--gains: expected {name} of 0 or more, found {value:g}.")
    return given


def _read_file(path: str) -> Given:
    what = "KP,KI,KD or a file of gains"
    try:
        content = parse_json(read_text(path, what, MOST_JSON_BYTES), shown(path), what)
    except DataError as error:
        raise DataError(f"--gains: {error}") from None
    content = content.get("gains", content) if isinstance(content, dict) else {}
    if not isinstance(content, dict):
        content = {}
    prefix = "pid." if any(name.startswith("pid.") for name in content) else ""
    fields = [f"{prefix}{name}" for name in _PID]
    for name in GAINS:
        if f"{prefix}{name}" not in content:
            raise DataError(f"{path}: expected the key {prefix}{name} with a number, found none; add it.")
    known = {*fields, *(name for names in _OWN.values() for name in names)}
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
