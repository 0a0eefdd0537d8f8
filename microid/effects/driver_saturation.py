"""Driver saturation: the amplifier's rails cut the command off."""

from typing import Any, ClassVar, Self

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from microid._in_numpy import _NumpySignal
from microid._linear import Times
from microid._param import param
from microid._part import AbstractPart, Signal
from microid.effects._base import AbstractEffect, Place, Scales, register

# Of the range; and a gain from which a fit finds the way to others.
_LEVELS, _SOME = (0.99, 0.97, 0.94, 0.90), 0.03


@register
class DriverSaturation(AbstractEffect):
    r"""An upper rail.

    .. math:: \min(u, u_{max} + g (u - u_{max}))

    There is no strength: the effect vanishes as the rail moves beyond the range of the command.

    Attributes
    ----------
    rail_V
        `u_max`, of the command.
    gain_beyond
        `g`: what a soft rail lets through of what is beyond it; none of it by default.
    """

    name: ClassVar[str] = "driver_saturation"
    takes: ClassVar[str] = "V"
    gives: ClassVar[str] = "V"
    place: ClassVar[Place] = "driver"
    strength: ClassVar[tuple[str, ...]] = ()
    finite: ClassVar[bool] = True
    fingerprint: ClassVar[str] = (
        "The displacement is flat beyond a level of the command, and after it as though it had turned at that level."
    )
    confusions: ClassVar[tuple[str, ...]] = ("sensor_nonlinearity", "slew_limit", "backlash", "end_stop")
    experiment: ClassVar[str] = "Two peaks of different height beyond the level, each held."
    source: ClassVar[str] = "rails at 95 to 103 % of the nominal range under load (estimate)"
    column: ClassVar[str] = "drive_monitor_V"
    rail_V: Float[Array, ""] = param(unit="V", scale=10.0)
    gain_beyond: Float[Array, ""] = param(default=0.0, unit="1", lower=0.0, upper=1.0)

    @classmethod
    def probes(cls, scales: Scales, inner: AbstractPart | None) -> tuple[tuple[Self, ...], ...]:
        """Rails at 99, 97, 94 and 90 % of the range."""
        span = scales.upper_V - scales.lower_V
        return tuple((cls(jnp.asarray(scales.lower_V + level * span), jnp.asarray(_SOME)),) for level in _LEVELS)

    def run(self, time_s: Times, signal: Signal, start: Any = None) -> Signal:
        """Cut off what is above the rail."""
        beyond = [(x, _beyond(self, x)) for x in (signal.values, signal.before)]
        # Where both are computed anew, as compilers do, neither need equal their minimum, which has no slope then.
        values, before = (jnp.where(x < y, x, y) for x, y in beyond)
        return signal.with_values(values, before)

    def in_numpy(self, interval_s: np.ndarray, signal: _NumpySignal) -> _NumpySignal:
        """Cut off what is above the rail."""
        beyond = [(x, _beyond(self, x)) for x in (signal.values, signal.before)]
        values, before = (np.where(x.real < y.real, x, y) for x, y in beyond)
        return signal._replace(values=values, before=before)


@register
class LowerDriverSaturation(AbstractEffect):
    """A lower rail; see `DriverSaturation`.

    Attributes
    ----------
    rail_V
        `u_min`, of the command.
    gain_beyond
        See `DriverSaturation`.
    """

    name: ClassVar[str] = "driver_saturation"
    form: ClassVar[str] = "lower"
    takes: ClassVar[str] = "V"
    gives: ClassVar[str] = "V"
    place: ClassVar[Place] = "driver"
    strength: ClassVar[tuple[str, ...]] = ()
    finite: ClassVar[bool] = True
    fingerprint: ClassVar[str] = DriverSaturation.fingerprint
    confusions: ClassVar[tuple[str, ...]] = DriverSaturation.confusions
    experiment: ClassVar[str] = DriverSaturation.experiment
    source: ClassVar[str] = DriverSaturation.source
    column: ClassVar[str] = "drive_monitor_V"
    rail_V: Float[Array, ""] = param(unit="V", scale=10.0)
    gain_beyond: Float[Array, ""] = param(default=0.0, unit="1", lower=0.0, upper=1.0)

    @classmethod
    def probes(cls, scales: Scales, inner: AbstractPart | None) -> tuple[tuple[Self, ...], ...]:
        """Rails at 1, 3, 6 and 10 % of the range."""
        span = scales.upper_V - scales.lower_V
        return tuple((cls(jnp.asarray(scales.upper_V - level * span), jnp.asarray(_SOME)),) for level in _LEVELS)

    def run(self, time_s: Times, signal: Signal, start: Any = None) -> Signal:
        """Cut off what is below the rail."""
        beyond = [(x, _beyond(self, x)) for x in (signal.values, signal.before)]
        values, before = (jnp.where(x > y, x, y) for x, y in beyond)
        return signal.with_values(values, before)

    def in_numpy(self, interval_s: np.ndarray, signal: _NumpySignal) -> _NumpySignal:
        """Cut off what is below the rail."""
        beyond = [(x, _beyond(self, x)) for x in (signal.values, signal.before)]
        values, before = (np.where(x.real > y.real, x, y) for x, y in beyond)
        return signal._replace(values=values, before=before)


def _beyond(effect: Any, voltage_V: Any) -> Any:
    """What the amplifier gives beyond its rail."""
    return effect.rail_V + effect.gain_beyond * (voltage_V - effect.rail_V)
