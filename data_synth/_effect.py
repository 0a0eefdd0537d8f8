"""What an effect is, and the registry that its function enters by being defined."""

import inspect
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, TypeAlias, TypeVar

import numpy as np

from data_synth._errors import ScenarioError
from data_synth._plant import Plant
from data_synth._rig import Rig
from data_synth._types import FloatArray

Place: TypeAlias = Literal[
    "history",
    "command",
    "driver",
    "hysteresis",
    "static",
    "mechanics",
    "environment",
    "sensor",
    "sampling",
    "reading",
]
"""Where in the chain an effect acts: the order of these names is the order of the chain."""

Function = TypeVar("Function", bound=Callable[..., Any])

POSITIVE = (0.0, math.inf)

TimeConstant: TypeAlias = float | Callable[[float, float], float]
"""A driver's time constant (s), or what that is at a voltage of the piezo, so far (V) behind the command."""

# Of anything that an effect counts.
_MOST = 1000

Range: TypeAlias = tuple[float, float] | tuple[str, ...]


@dataclass(eq=False)
class Situation:
    """What surrounds an effect while one run is played: the rig, the run, and the signals so far.

    Signals of shape (N,) stand on the fine grid `time_s`, which is `refinement` times as fine as the samples and
    goes on for some samples after the last, with the command at rest.

    Attributes
    ----------
    rig, plant
        The stage; the plant is None where it is quasi-static.
    index
        The place of the run among the runs.
    sample_rate_Hz, samples, refinement
        Samples per second, samples, and fine steps per sample.
    time_s
        The fine grid, shape (N,), in s from the start of the run.
    start_s
        When the run starts, in s since the first run did.
    path_before_V
        How far the voltage has travelled in the runs before, in V.
    temperature_K
        The stage's temperature above its mean, shape (N,), in K; None where the room is not modelled.
    other_um
        The displacement of a second axis, shape (N,), in um; None where there is none.
    voltage_V
        The driver's voltage, shape (N,), in V; filled in when it is known.
    rng
        What is random in the realisation of an effect; the same for each strength of it.
    """

    rig: Rig
    plant: Plant
    index: int
    sample_rate_Hz: float
    samples: int
    refinement: int
    time_s: FloatArray
    start_s: float = 0.0
    path_before_V: float = 0.0
    temperature_K: FloatArray | None = None
    other_um: FloatArray | None = None
    voltage_V: FloatArray = field(default_factory=lambda: np.empty(0))
    rng: np.random.Generator = field(default_factory=np.random.default_rng)

    @property
    def step_s(self) -> float:
        """The width of the fine grid, in s."""
        return 1 / (self.sample_rate_Hz * self.refinement)

    @property
    def duration_s(self) -> float:
        """From the first sample to the last, in s."""
        return (self.samples - 1) / self.sample_rate_Hz


@dataclass(frozen=True)
class Effect:
    """An entry of the registry.

    Attributes
    ----------
    name
        The name of the function.
    place
        Where in the chain it acts.
    function
        From what is at that place, and a `Situation`, to what is there with the effect. Its keyword arguments are
        the keys of its TOML table.
    size
        The argument that is scaled to reach a strength.
    usual, limit
        Its usual value, and the strongest that physics allows. A limit below the usual value says that less of it is
        stronger.
    draws
        Ranges of the other arguments, drawn evenly on a logarithmic scale, or words to choose from.
    outside
        Whether a library of effects to diagnose does not hold it.
    own
        Whether it is the stage's own way, as of the second truth of `hidden`, and no fault to be found.
    needs
        What must be there: `driver`, `mass` or `other_axis`.
    between
        What arguments must lie between, ends excluded, where not every finite number makes sense.
    """

    name: str
    place: Place
    function: Callable[..., Any]
    size: str
    usual: float
    limit: float
    draws: Mapping[str, Range]
    outside: bool
    own: bool
    needs: str | None
    between: Mapping[str, tuple[float, float]]

    def signals(self) -> tuple[str, ...]:
        """Names of the function's arguments that are no settings: the signal and the situation."""
        return tuple(inspect.signature(self.function).parameters)[:2]

    def defaults(self) -> dict[str, Any]:
        """The settings that have a usual value, with it."""
        found = inspect.signature(self.function).parameters.items()
        return {name: value.default for name, value in found if value.default is not value.empty}

    def require_sense(self, settings: Mapping[str, Any]) -> None:
        """Raise ValueError for a setting beyond what it must lie between; whole numbers are counts."""
        for name, value in settings.items():
            low, high = self.between.get(name, (-math.inf, math.inf))
            if not isinstance(value, str) and not low < value < high:
                within = f"above {low:g}" if high == math.inf else f"between {low:g} and {high:g}"
                raise ValueError(f"{name} must be {within}, got {value:g}")
            if type(value) is int and not 0 <= value <= _MOST:
                raise ValueError(f"{name} must be 0 to {_MOST}, got {value}")

    def require(self, plant: Plant | None, where: str) -> None:
        """Raise ScenarioError where the stage lacks what the effect acts on."""
        if self.needs == "driver" and (plant is None or plant.time_constant_s is None):
            raise ScenarioError(f"{where}: {self.name} needs a driver: state time_constant_s in [plant]")
        if self.needs == "mass" and (plant is None or plant.natural_frequency_Hz is None):
            raise ScenarioError(f"{where}: {self.name} needs a mass: state natural_frequency_Hz in [plant]")


REGISTRY: dict[str, Effect] = {}
"""Every effect by its name."""


def effect(
    place: Place,
    size: str,
    usual: float,
    limit: float,
    draws: Mapping[str, Range] | None = None,
    *,
    outside: bool = False,
    own: bool = False,
    needs: str | None = None,
    between: Mapping[str, tuple[float, float]] | None = None,
) -> Callable[[Function], Function]:
    """Enter a function into the registry under its own name; the arguments are those of `Effect`."""

    def enter(function: Function) -> Function:
        name = function.__name__
        REGISTRY[name] = Effect(
            name, place, function, size, usual, limit, dict(draws or {}), outside, own, needs, dict(between or {})
        )
        return function

    return enter
