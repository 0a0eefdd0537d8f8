"""Linear parts of a stage in NumPy; see `microid.LinearSystem`, `microid.Driver` and the others.

Numbers may be complex: along a tiny imaginary part all that is computed has its derivative (Squire and Trapp, 1998).
"""

import ast
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Self

import numpy as np

# As in `microid`: terms of the exponential series for a norm of a half, and doublings at most.
_TERMS, _DOUBLINGS = 16, 64
_EPS = float(np.finfo(float).eps)


@dataclass(frozen=True)
class Linear:
    """A stable linear system of `n` states in its deviation from rest; see `microid.LinearSystem`.

    The shape of `rate_per_s` is `(n, n)`, those of `rest` and `read` are `(n,)`.
    """

    rate_per_s: np.ndarray
    rest: np.ndarray
    read: np.ndarray
    gain: complex
    offset: complex

    @classmethod
    def memoryless(cls, gain: complex, offset: complex = 0.0) -> Self:
        """A gain and an offset, without states."""
        return cls(np.zeros((0, 0)), np.zeros(0), np.zeros(0), gain, offset)

    def then(self, other: "Linear") -> "Linear":
        """Put another system behind this one."""
        inward = other.rate_per_s @ other.rest
        none = np.zeros((len(self.rest), len(other.rest)))
        through = other.gain - other.read @ other.rest
        return Linear(
            np.block([[self.rate_per_s, none], [-np.outer(inward, self.read), other.rate_per_s]]),
            np.concatenate([self.rest, self.gain * other.rest]),
            np.concatenate([through * self.read, other.read]),
            other.gain * self.gain,
            other.gain * self.offset + other.offset,
        )

    def respond(self, interval_s: np.ndarray, signal: np.ndarray, before: np.ndarray, hold: str) -> np.ndarray:
        """Respond to samples of signals, `(t, k)`, which rested at `before`, `(k,)`; see `microid.LinearSystem`.

        Intervals are `(t - 1,)`, or `(1,)` where all are alike; the `hold` is `first`, `zero` or `smooth`.
        """
        level = self.offset + self.gain * signal
        if len(self.rest) == 0:
            return level
        if hold == "smooth":
            bent = signal - _bend(interval_s, signal)
            directly = self.gain - self.read @ self.rest
            return self.respond(interval_s, bent, before, "first") + directly * (signal - bent)
        start = self.rest[:, None] * (before - signal[0])
        moved, _ = self.move(interval_s, np.diff(signal, axis=0), start, hold)
        return level + np.concatenate([(self.read @ start)[None], moved])

    def move(
        self, interval_s: np.ndarray, change: np.ndarray, start: np.ndarray, hold: str
    ) -> tuple[np.ndarray, np.ndarray]:
        """What the states add to the output after each change of signals, `(t, k)`, and the states in the end.

        Intervals are `(t,)` or `(1,)`; states are `(n, k)`.
        """
        if len(self.rest) == 0:
            return np.zeros_like(change), start
        step, taken = self._advance(interval_s, hold)
        push = -taken[:, :, None] * change[:, None]
        states = recur(step, push, start)
        return self.read @ states, states[-1] if len(states) else start

    def _advance(self, interval_s: np.ndarray, hold: str) -> tuple[np.ndarray, np.ndarray]:
        """Matrices `exp(A h)`, and what the states lose by an input that rises by one, `(t, n, n)` and `(t, n)`."""
        longest = float(np.max(interval_s, initial=_EPS))
        norm = float(np.max(np.sum(np.abs(self.rate_per_s * longest), axis=1)))
        doublings = int(np.clip(np.ceil(np.log2(max(norm, _EPS))) + 1, 0, _DOUBLINGS))
        share = self.rate_per_s * (interval_s * 2.0**-doublings)[:, None, None]
        one = np.eye(len(self.rest))
        mean = np.broadcast_to(one, share.shape)
        # Horner's scheme for (exp(X) - 1) / X.
        for term in range(_TERMS, 0, -1):
            mean = (one + share @ mean) / term
        less, lost = share @ mean, mean @ self.rest
        # Doubling exp(X) - 1 rather than exp(X) keeps the digits of slow states beside fast ones.
        for _ in range(doublings):
            less, lost = 2 * less + less @ less, lost + (less @ lost[..., None])[..., 0] / 2
        return one + less, lost if hold == "first" else np.broadcast_to(self.rest, lost.shape)


def recur(step: np.ndarray, push: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Solve `z[t] = step[t] @ z[t - 1] + push[t]` from a start, `(n, k)`, for `(t, n, k)`.

    There is a step, `(n, n)`, for each sample, or one for all. Blocks of samples go side by side, each from zero on,
    and are led on from each other in the end.
    """
    count, n, k = push.shape
    length = int(np.ceil(np.sqrt(count)))
    blocks = -(-count // max(length, 1))
    fill = ((0, blocks * length - count), (0, 0), (0, 0))
    inside = np.pad(push, fill).reshape(blocks, length, n, k).astype(np.result_type(step, push, start), copy=False)
    each = step[None] if len(step) == 1 else np.pad(step, fill).reshape(blocks, length, n, n)
    over = np.empty((len(each), length, n, n), dtype=step.dtype)
    whole = np.broadcast_to(np.eye(n), (len(each), n, n))
    for j in range(length):
        now = each[:, min(j, each.shape[1] - 1)]
        over[:, j] = whole = now @ whole
        if j > 0:
            inside[:, j] += now @ inside[:, j - 1]
    for b in range(blocks):
        inside[b] += over[min(b, len(over) - 1)] @ start
        start = inside[b, -1]
    return inside.reshape(-1, n, k)[:count]


def _bend(interval_s: np.ndarray, signal: np.ndarray) -> np.ndarray:
    """How far lines through the samples of smooth signals lie beside them on average, `(t, k)`; see `microid`."""
    bend = np.zeros_like(signal)
    each = np.broadcast_to(interval_s, max(len(signal) - 1, 0))[:, None]
    slope = np.diff(signal, axis=0) / each
    early, late = each[:-1], each[1:]
    bend[1:-1] = np.diff(slope, axis=0) * early * late / (6 * (early + late))
    return bend


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


SYSTEMS: Mapping[str, Callable[..., Linear]] = {"Driver": _driver, "Mechanics": _mechanics, "Sensor": _sensor}


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
        return SYSTEMS[self.kind](**self.values)

    @property
    def ahead(self) -> bool:
        """Whether it stands ahead of the hysteresis, where a voltage is passed on, and not a displacement."""
        return self.kind == "Driver"
