"""Linear parts of a stage that do without JAX; see `microid.Driver` and the others."""

import ast
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from fits.stage._plain_linear import Linear


@dataclass(frozen=True)
class Declared:
    """What `microid.param` says of a field of one number: its unit, scale and lower bound."""

    unit: str
    scale: float = 1.0
    lower: float = -math.inf
    default: float | None = None

    def slope(self, value: float) -> float:
        """Derivative of the parameter by its coordinate, at a value above the bound; see `microid.Coordinates`."""
        return self.scale * (-math.expm1((self.lower - value) / self.scale) if math.isfinite(self.lower) else 1.0)

    def inside(self, value: float) -> bool:
        """Whether a value is off its bound: on it, coordinates are infinite."""
        return value > self.lower + 1e-6 * self.scale


@cache
def declared() -> dict[str, dict[str, Declared]]:
    """Fields of the linear parts of `microid` by the names of both, in their order.

    They are read off the file that declares them: importing it would start JAX.
    """
    package = find_spec("microid")
    assert package is not None
    assert package.origin is not None
    text = Path(package.origin).with_name("_plant.py").read_text(encoding="utf-8")
    classes = [node for node in ast.parse(text).body if isinstance(node, ast.ClassDef)]
    return {each.name: dict(_fields(each)) for each in classes}


def _fields(of: ast.ClassDef) -> Any:
    for node in of.body:
        call = getattr(node, "value", None)
        if isinstance(node, ast.AnnAssign) and isinstance(call, ast.Call) and isinstance(node.target, ast.Name):
            said = {str(one.arg): ast.literal_eval(one.value) for one in call.keywords}
            yield node.target.id, Declared(**said)


def _driver(time_constant_s: complex, gain: complex) -> Linear:
    one = np.ones(1)
    return Linear(np.array([[-1 / time_constant_s]]), one, gain * one, gain, 0.0)


def _mechanics(natural_frequency_Hz: complex, damping_ratio: complex, gain: complex) -> Linear:
    rate = 2 * np.pi * natural_frequency_Hz
    matrix = np.array([[0.0, rate], [-rate, -2 * damping_ratio * rate]])
    return Linear(matrix, np.array([1.0, 0.0]), gain * np.array([1.0, 0.0]), gain, 0.0)


def _sensor(gain: complex, offset_um: complex) -> Linear:
    return Linear.memoryless(gain, offset_um)


_SYSTEMS: Mapping[str, Callable[..., Linear]] = {"Driver": _driver, "Mechanics": _mechanics, "Sensor": _sensor}
# What goes in and comes out of each: parts ahead of the hysteresis carry a voltage, those behind it a displacement.
_AHEAD, _BEHIND = ("Driver",), ("Mechanics", "Sensor")


@dataclass(frozen=True)
class PlainPart:
    """A linear part by its kind, the name of a class of `microid`, and its parameters, which may be complex."""

    kind: str
    values: Mapping[str, complex]

    @property
    def fields(self) -> dict[str, Declared]:
        """What is said of its parameters."""
        return declared()[self.kind]

    def system(self) -> Linear:
        """The part as differential equations."""
        return _SYSTEMS[self.kind](**self.values)

    @property
    def ahead(self) -> bool:
        """Whether it stands ahead of the hysteresis: it passes on a voltage."""
        return self.kind in _AHEAD


def kinds() -> tuple[str, ...]:
    """Kinds of parts."""
    return tuple(_SYSTEMS)
