"""What a feedback controller is: a state, and one step per sample; and how one is made."""

import abc
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar, Self, TypeVar

import equinox as eqx
import numpy as np
from jaxtyping import Array, Complex, Float

from microid._param import _KEY, ParameterSpec
from microid._stage import Stage


@dataclass(frozen=True)
class ControlTask:
    """What a controller is made for. What takes long to find is a function, as most controllers ask for little.

    Attributes
    ----------
    stage
        The nominal one.
    interval_s
        Between two samples.
    reference_um
        What is to be followed, shape `(t,)`.
    static_V
        Command that would hold the stage there, shape `(t,)`.
    slope_um_per_V
        Of the stage's hysteresis where it is steepest; None without one.
    frequency_Hz
        Of the reference; None where it does not oscillate.
    """

    stage: Stage
    interval_s: float
    reference_um: Callable[[], np.ndarray]
    static_V: Callable[[], np.ndarray]
    slope_um_per_V: Callable[[], float | None]
    frequency_Hz: Callable[[], float | None]


class ControlledPlant(eqx.Module):
    """The nominal plant of a loop.

    Attributes
    ----------
    stage
        See `margins`.
    slope_um_per_V
        Of its hysteresis where it is steepest; None without one.
    delay
        How many samples old the reading is.
    """

    stage: Stage
    slope_um_per_V: Float[Array, ""] | None
    delay: int = eqx.field(static=True)


@dataclass(frozen=True)
class Setting:
    """A number that is stated of a controller, or varied from row to row of a sweep.

    Attributes
    ----------
    name
        A field of the PID controller that it is made around, or what `AbstractController.of` knows it by.
    unit
        Empty: that of the `param` field of that name, of the controller or of its PID controller.
    lower, upper
        Bounds, beside those of that field.
    default
        What it is where nothing is stated, or how that is found: a `ValueError` says why it is not. None where
        `AbstractController.of` finds it by the plant.
    said
        What is to be said where the default is taken, with a place for it.
    varies
        Whether it may differ from row to row.
    whole
        Whether it is a whole number.
    several
        Whether there may be several of it, and as many of all such settings.
    of_rate
        Whether the upper bound is a share of the sampling rate.
    above
        Whether it must be above the lower bound.
    """

    name: str
    unit: str = ""
    lower: float = -math.inf
    upper: float = math.inf
    default: float | Callable[[ControlTask], float] | None = None
    said: str = ""
    varies: bool = True
    whole: bool = False
    several: bool = False
    of_rate: bool = False
    above: bool = False


class AbstractController(eqx.Module):
    """A discrete feedback controller that adds its voltage to a feedforward.

    To add one to the command and to sweeps, put one file with one final, registered subclass into
    `microid/control/`; it has the name of its file, with dashes. Each is made around a PID controller, whose gains
    are tuned or given.

    The paper's Eq. (23), (24) and (32) leave the feedforward out of the total control (erratum 28). Here a controller
    is given it at every step: only who knows the whole command can keep it within its limits without winding up.

    Attributes
    ----------
    interval_s
        Between two samples.
    settings
        What may be stated of it.
    own
        Paths of all that makes it again, beside its PID controller: of fields with what was fitted or chosen.
    learns
        Whether it finds what is its own while it runs, so that only the PID controller it begins as is tuned.
    """

    settings: ClassVar[tuple[Setting, ...]] = ()
    own: ClassVar[tuple[str, ...]] = ()
    learns: ClassVar[bool] = False
    if TYPE_CHECKING:
        # A checker takes abstract fields for fields of a dataclass and complains of their order.
        @property
        def interval_s(self) -> Float[Array, ""]: ...
    else:
        interval_s: eqx.AbstractVar[Float[Array, ""]]

    @classmethod
    @abc.abstractmethod
    def of(cls, pid: Any, numbers: Mapping[str, Any], plant: ControlledPlant | None) -> Self:
        """Make it around a PID controller; a pure function, mapped over the rows of a sweep.

        Parameters
        ----------
        pid
            A `PID` with its interval and limits.
        numbers
            The settings that are no fields of it, by name.
        plant
            By which settings without a default are found; None where all of them are given.

        Raises
        ------
        ValueError
            If it cannot be made.
        """

    @abc.abstractmethod
    def linear(self) -> "AbstractLinearController":
        """The linear controller that it is at first, for its margins."""

    @abc.abstractmethod
    def init(self, rest_um: Float[Array, ""] | float = 0.0, feedback_V: Float[Array, ""] | float = 0.0) -> Any:
        """State before the first sample, at rest.

        Parameters
        ----------
        rest_um
            Where the stage stood, which was also the reference.
        feedback_V
            What the controller added to the feedforward to keep it there.
        """

    @abc.abstractmethod
    def step(
        self,
        state: Any,
        reference_um: Float[Array, ""],
        measured_um: Float[Array, ""],
        feedforward_V: Float[Array, ""] | float = 0.0,
    ) -> tuple[Any, Float[Array, ""]]:
        """Choose the command until the next sample.

        Parameters
        ----------
        state
            From `init` or the step before.
        reference_um, measured_um
            Wanted and measured displacement.
        feedforward_V
            What the command would be without feedback.

        Returns
        -------
        state, command_V
            The next state, and the whole command, feedforward included.
        """


class AbstractLinearController(AbstractController):
    """A controller that is linear but for its limits, so that the loop has margins."""

    def linear(self) -> "AbstractLinearController":
        """Itself."""
        return self

    @abc.abstractmethod
    def transfer(self, z: Complex[Array, "..."]) -> Complex[Array, "..."]:
        """Feedback per error, in V/um, at points of the z-plane; without limits."""

    @abc.abstractmethod
    def _unlimited(self) -> Self:
        """The same without limits."""

    @abc.abstractmethod
    def _driven(self, state: Any) -> Any:
        """State in which what nothing is ever added to is zero: it is a constant, and no pole of the loop."""


CONTROLLERS: dict[str, type[AbstractController]] = {}
"""Every controller, by the name of its file, with dashes, as on the command line."""
_Controller = TypeVar("_Controller", bound=type[AbstractController])


def register(controller: _Controller) -> _Controller:
    """Make a controller known under the name of its file; used as a decorator there.

    Raises
    ------
    ValueError
        If the file has registered one before.
    """
    name = controller.__module__.rpartition(".")[2].replace("_", "-")
    if name in CONTROLLERS:
        raise ValueError(f"the controller {name!r} is defined twice")
    CONTROLLERS[name] = controller
    return controller


def settings_of(controller: type[AbstractController]) -> tuple[Setting, ...]:
    """The settings of a controller, with the units and bounds of the `param` fields that they stand for."""
    specs: dict[str, ParameterSpec] = {}
    for each in (CONTROLLERS["pid"], controller):
        fields = getattr(each, "__dataclass_fields__", {})
        specs |= {name: field.metadata[_KEY] for name, field in fields.items() if _KEY in field.metadata}
    found = []
    for setting in controller.settings:
        if not setting.unit:
            spec = specs[setting.name]
            lower, upper = max(setting.lower, spec.lower), min(setting.upper, spec.upper)
            setting = replace(setting, unit=spec.unit, lower=lower, upper=upper)
        found.append(setting)
    return tuple(found)
