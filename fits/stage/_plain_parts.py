"""Parts of a stage in NumPy: linear ones, and effects that have such a form; see `microid.Driver` and the others.

Parameters may be complex, as for `Linear`.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from itertools import groupby
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from fits.loop._plain_file import array_of, fields_of
from fits.stage._declared import Declared, declared, form_of, tools
from fits.stage._plain_linear import Linear

if TYPE_CHECKING:
    from microid._in_numpy import _NumpySignal
else:
    _NumpySignal = tools()._NumpySignal


def _driver(time_constant_s: complex, gain: complex) -> Linear:
    one = np.ones(1)
    return Linear(np.array([[-1 / time_constant_s]]), one, gain * one, gain, 0.0)


def _lag(time_constant_s: complex) -> Linear:
    return _driver(time_constant_s, 1.0)


def _mechanics(natural_frequency_Hz: complex, damping_ratio: complex, gain: complex) -> Linear:
    rate = 2 * np.pi * natural_frequency_Hz
    matrix = np.array([[0.0, rate], [-rate, -2 * damping_ratio * rate]])
    return Linear(matrix, np.array([1.0, 0.0]), gain * np.array([1.0, 0.0]), gain, 0.0)


def _sensor(gain: complex, offset_um: complex) -> Linear:
    return Linear.memoryless(gain, offset_um)


SYSTEMS: Mapping[str, Callable[..., Linear]] = {
    "Driver": _driver,
    "Lag": _lag,
    "Mechanics": _mechanics,
    "Sensor": _sensor,
}


@dataclass(frozen=True)
class PlainLinear:
    """A linear part by its kind, the name of a class of `microid`, and its parameters."""

    kind: str
    values: Mapping[str, Any]

    @property
    def fields(self) -> Mapping[str, Declared]:
        """What is said of its parameters."""
        return declared()[self.kind]

    def system(self) -> Linear:
        """The part as differential equations."""
        return SYSTEMS[self.kind](**self.values)

    @property
    def ahead(self) -> bool:
        """Whether it stands ahead of the hysteresis, where a voltage is passed on, and not a displacement."""
        return self.kind == "Driver"


@dataclass(frozen=True)
class PlainEffect:
    """An effect of `microid.effects.EFFECTS` by the name of its class, and its fields, its history zero."""

    kind: str
    values: Mapping[str, Any]

    @property
    def fields(self) -> Mapping[str, Declared]:
        """What is said of its parameters; what is given is none."""
        return {name: said for name, said in form_of(self.kind).fields.items() if said is not None}

    @property
    def ahead(self) -> bool:
        """As that of a linear part."""
        return form_of(self.kind).gives == "V"

    @property
    def history(self) -> tuple[str, ...]:
        """Parameters that are zero."""
        return form_of(self.kind).history

    def run(self, interval_s: np.ndarray, signal: _NumpySignal) -> _NumpySignal:
        """Pass signals on."""
        return form_of(self.kind).run(SimpleNamespace(**self.values), interval_s, signal)


PlainPart: TypeAlias = PlainLinear | PlainEffect


def read_part(item: Mapping[str, Any]) -> PlainPart:
    """A part of a model file; one of the exceptions `ODD` where it has no form in NumPy, or is odd."""
    kind = item["type"]
    fields: Mapping[str, Declared | None] = declared()[kind] if kind in SYSTEMS else form_of(kind).fields
    values: dict[str, Any] = {}
    for (name, said), value in zip(fields.items(), fields_of(item, kind, *fields), strict=True):
        array = array_of(value, 0) if said is None else array_of(value, len(said.shape), said.unit, said.lower)
        if said is not None and not (array.shape == said.shape and np.all(array <= said.upper)):
            raise ValueError("out of bounds")
        values[name] = array if array.ndim else float(array)
    if kind in SYSTEMS:
        return PlainLinear(kind, values)
    if any(np.any(values[name]) for name in form_of(kind).history):
        raise ValueError("something goes on from before the record")
    return PlainEffect(kind, values)


def around(parts: Sequence[PlainPart]) -> tuple[Linear, Linear]:
    """What is linear ahead of the hysteresis and behind it, as one system each."""
    ahead, behind = (
        _joined(part for part in parts if isinstance(part, PlainLinear) and part.ahead == first)
        for first in (True, False)
    )
    return ahead, behind


def through(parts: Iterable[PlainPart], interval_s: np.ndarray, signal: _NumpySignal) -> _NumpySignal:
    """Pass signals through parts at rest, of which linear neighbours are one system."""
    for linear, group in groupby(parts, lambda part: isinstance(part, PlainLinear)):
        neighbours: list[Any] = list(group)
        if linear:
            signal = _through(_joined(neighbours), interval_s, signal)
            continue
        for effect in neighbours:
            signal = effect.run(interval_s, signal)
    return signal


def _joined(parts: Iterable[Any]) -> Linear:
    return reduce(Linear.then, (part.system() for part in parts), Linear.memoryless(1.0))


def _through(system: Linear, interval_s: np.ndarray, signal: _NumpySignal) -> _NumpySignal:
    found, before = system.respond(interval_s, *signal), system.offset + system.gain * signal.before
    if len(system.rest) == 0:
        return signal._replace(values=found, before=before)
    if len(system.rest) == 1 and signal.hold == "zero":
        return _NumpySignal(found, before, "first", -1 / system.rate_per_s[0, 0])
    # Behind a step even what comes out of an inertia may have a corner.
    return _NumpySignal(found, before, "first" if signal.hold == "zero" else "smooth")
