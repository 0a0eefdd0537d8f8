"""What a part of a stage is: something that turns one sampled signal into another."""

import abc
from collections.abc import Iterable, Sequence
from functools import reduce
from itertools import groupby
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Complex, Float

from microid._linear import Hold, LinearSystem, Times


class Signal(eqx.Module):
    """A signal on its way from one part to the next.

    Attributes
    ----------
    values
        Samples, shape `(t,)`, in the unit that the part before gives.
    before
        The constant value before the first sample, at which everything was at rest.
    hold
        How the signal runs between samples: in lines, `"first"`, in steps, `"zero"`, or `"smooth"`, as what comes out
        of an inertia does.
    settling_s
        Where a signal in lines settles from each sample to the next instead, as behind a driver whose command is
        held: with this time constant, shape `()`.
    """

    values: Float[Array, " t"]
    before: Float[Array, ""]
    hold: Hold = eqx.field(static=True)
    settling_s: Float[Array, ""] | None = None

    def with_values(self, values: Float[Array, " t"], before: Float[Array, ""]) -> "Signal":
        """Another signal that runs between its samples as this one does."""
        return Signal(values, before, self.hold, self.settling_s)


class Scene(eqx.Module):
    """What a part may look at beside the signal that comes in.

    Attributes
    ----------
    command
        What went into the first part.
    columns
        Further columns of the record by name, such as `temperature_degC`, each of shape `(t,)`.
    memory
        State of the hysteresis before it came to rest under the command before the first sample.
    past_um
        What the hysteresis gives beside that, shape `(t,)`, where that state is not the one that it was in.
    """

    command: Signal
    columns: dict[str, Float[Array, " t"]]
    memory: Any = None
    past_um: Float[Array, " t"] | None = None


class AbstractPart(eqx.Module):
    """One link of the chain that a `Stage` is.

    Attributes
    ----------
    takes, gives
        Units of the signals that go in and come out.
    """

    takes: eqx.AbstractClassVar[str]
    gives: eqx.AbstractClassVar[str]

    @abc.abstractmethod
    def run(self, time_s: Times, signal: Signal, start: Any = None) -> Signal:
        """Pass a signal on.

        Parameters
        ----------
        time_s
            Times of the samples, shape `(t,)`, or the one interval between them, shape `()`.
        signal
            What goes in.
        start
            The `Scene` of the record.
        """


def innermost(part: Any) -> Any:
    """The part that stands inside of all that is put around it, or the part itself."""
    while hasattr(part, "inner"):
        part = part.inner
    return part


class AbstractLinear(AbstractPart):
    """A part with a transfer function. Neighbours of this kind are solved together, exactly."""

    @abc.abstractmethod
    def system(self) -> LinearSystem:
        """The part as differential equations."""

    @abc.abstractmethod
    def transfer(self, s_rad_per_s: Complex[Array, "..."]) -> Complex[Array, "..."]:
        """Transfer function at complex frequencies, output unit per input unit."""

    @property
    @abc.abstractmethod
    def poles_rad_per_s(self) -> Complex[Array, " n"]:
        """Poles of the transfer function, shape `(n,)`."""

    @property
    def static_gain(self) -> Float[Array, ""]:
        """Output per input at rest, in the unit of what the part gives over that of what it takes."""
        return self.system().gain

    def frequency_response(self, frequency_Hz: Float[Array, "..."]) -> Complex[Array, "..."]:
        """Transfer function along the imaginary axis, in the unit of `static_gain`."""
        return self.transfer(_imaginary(frequency_Hz))

    def run(self, time_s: Times, signal: Signal, start: Any = None) -> Signal:
        """Pass a signal on; linear parts start from rest."""
        return _run_linear(self.system(), time_s, signal)


class AbstractHysteresis(AbstractPart):
    """A rate-independent law between voltage and displacement: its output depends on the path, not on its speed."""

    takes: ClassVar[str] = "V"
    gives: ClassVar[str] = "um"

    @abc.abstractmethod
    def __call__(self, voltage_V: Float[Array, " t"], start: Any = None) -> Float[Array, " t"]:
        """Displacement in um under a voltage, shape `(t,)`; `start` is the state before the first sample."""

    def run(self, time_s: Times, signal: Signal, start: Any = None) -> Signal:
        """Pass a voltage on, which has come from the scene's memory to its value before the first sample."""
        memory = start.memory if isinstance(start, Scene) else start
        displacement_um = self(jnp.concatenate([signal.before[None], signal.values]), memory)
        if isinstance(start, Scene) and start.past_um is not None:
            displacement_um = displacement_um + jnp.concatenate([start.past_um[:1], start.past_um])
        return signal.with_values(displacement_um[1:], displacement_um[0])


class AbstractStepper(eqx.Module):
    """A law of hysteresis one sample at a time, with a state of fixed size, as a feedback loop needs it."""

    @abc.abstractmethod
    def init(self, before_V: Float[Array, ""], start: Any = None) -> tuple[Any, Float[Array, ""]]:
        """State and displacement in um once the voltage has come from a `start`, that of the law, to rest."""

    @abc.abstractmethod
    def step(self, state: Any, voltage_V: Float[Array, ""]) -> tuple[Any, Float[Array, ""]]:
        """State and displacement in um at the next sample."""


def _joined(parts: Iterable[AbstractLinear]) -> LinearSystem:
    """Neighbouring linear parts as one system."""
    return reduce(LinearSystem.then, (part.system() for part in parts))


def _links(parts: Iterable[AbstractPart]) -> list[LinearSystem | AbstractPart]:
    """Parts in a row, with neighbouring linear ones joined."""
    links: list[LinearSystem | AbstractPart] = []
    for linear, group in groupby(parts, lambda part: isinstance(part, AbstractLinear)):
        neighbours: list[Any] = list(group)
        links += [_joined(neighbours)] if linear else neighbours
    return links


def _run_linear(system: LinearSystem, time_s: Times, signal: Signal, by_samples: bool = False) -> Signal:
    """Pass a signal through a linear system that was at rest; see `LinearSystem.respond`."""
    values = system.respond(time_s, signal.values, signal.before, signal.hold, by_samples, signal.settling_s)
    before = system.offset + system.gain * signal.before
    if system.order == 0:
        return signal.with_values(values, before)
    if system.order == 1 and signal.hold == "zero":
        return Signal(values, before, "first", -1 / system.rate_per_s[0, 0])
    # Behind a step even what comes out of an inertia may have a corner.
    return Signal(values, before, "first" if signal.hold == "zero" else "smooth")


def run_parts(parts: Sequence[AbstractPart], time_s: Times, signal: Signal, scene: Any = None) -> Signal:
    """Pass a signal through parts in a row, of which neighbouring linear ones are solved together.

    Parameters
    ----------
    parts
        In their order.
    time_s
        Times of the signal's samples, shape `(t,)`, or the one interval between all of them, shape `()`.
    signal
        What goes into the first.
    scene
        What parts know beside that; see `Scene`.

    Returns
    -------
    Signal
        What comes out of the last, its values of shape `(t,)`, in the unit that it gives.
    """
    for link in _links(parts):
        if isinstance(link, LinearSystem):
            signal = _run_linear(link, time_s, signal)
        else:
            signal = link.run(time_s, signal, scene)
    return signal


def _imaginary(frequency_Hz: Float[Array, "..."]) -> Complex[Array, "..."]:
    """Complex frequencies, in rad/s, of oscillations that neither grow nor decay."""
    return 2j * jnp.pi * _complex(jnp.asarray(frequency_Hz))


def _complex(value: Float[Array, "..."]) -> Complex[Array, "..."]:
    return lax.complex(value, jnp.zeros_like(value))
