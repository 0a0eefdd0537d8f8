"""End stop: something that the stage runs into before the end of its stroke."""

from typing import Any, ClassVar, Self

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from microid._linear import Times
from microid._param import param
from microid._part import AbstractPart, Signal, innermost
from microid.effects._base import AbstractEffect, Place, Scales, register
from microid.effects._oscillator import _braked, _forces_um

# Of the way that the stage goes; and a part of the motion from which a fit finds the way to firmer and softer stops.
_LEVELS, _SOME = (0.99, 0.97, 0.94, 0.90, 0.85, 0.80), 0.5


class _AbstractEndStop(AbstractEffect):
    """A spring on one side of the mass, in touch with it only beyond the stop."""

    name: ClassVar[str] = "end_stop"
    takes: ClassVar[str] = "um"
    gives: ClassVar[str] = "um"
    place: ClassVar[Place] = "mechanics"
    strength: ClassVar[tuple[str, ...]] = ()
    finite: ClassVar[bool] = True
    fingerprint: ClassVar[str] = (
        "Beyond a level of the displacement, and at no single voltage, it moves less, and rings faster."
    )
    confusions: ClassVar[tuple[str, ...]] = ("driver_saturation", "sensor_nonlinearity", "stiffness_hardening")
    experiment: ClassVar[str] = "A peak beyond the level that is reached from below and come back to from above."
    source: ClassVar[str] = (
        "unilateral contact, e.g. Brogliato, Nonsmooth Mechanics, 3rd ed. (Springer 2016), chapter 2; flexures and "
        "cables that touch in the last tenth of the stroke (estimate)"
    )
    _side: eqx.AbstractClassVar[float]
    inner: AbstractPart
    stop_um: Float[Array, ""] = param(unit="um", scale=10.0)
    gain_beyond: Float[Array, ""] = param(default=0.1, unit="1", lower=1e-3, upper=1.0)

    @classmethod
    def _probes(cls, inner: AbstractPart | None, levels_um: Any) -> tuple[tuple[Self, ...], ...]:
        return () if inner is None else tuple((cls(inner, jnp.asarray(at), jnp.asarray(_SOME)),) for at in levels_um)

    def run(self, time_s: Times, signal: Signal, start: Any = None) -> Signal:
        """Let the mechanics answer to what the stop leaves of the piezo's displacement."""
        mechanics = innermost(self.inner)
        spring = (1 / self.gain_beyond - 1) / mechanics.gain

        def law(_: Array, there: Array, memory: Any) -> tuple[Array, Any]:
            beyond = there - self.stop_um
            return spring * jnp.where(self._side * beyond > 0, beyond, 0.0), memory

        beyond = mechanics.gain * signal.before - self.stop_um
        taken = (1 - self.gain_beyond) / mechanics.gain
        before = taken * jnp.where(self._side * beyond > 0, beyond, 0.0)
        forces = _forces_um(mechanics, time_s, signal, law, before, ())
        return _braked(self.inner, time_s, signal, start, forces, before)


@register
class EndStop(_AbstractEndStop):
    r"""A stop above.

    .. math::
        \ddot x + 2 \zeta \omega \dot x + \omega^2 \left[x + (1 / g - 1) \max(x - x_{max}, 0)\right]
        = \omega^2 \lambda w

    There is no strength: the effect vanishes as the stop moves beyond the stroke.

    Attributes
    ----------
    inner
        The mechanics.
    stop_um
        `x_max`, where the stop begins to touch.
    gain_beyond
        `g`: the part of the displacement beyond the stop that is left at rest; next to none at a rigid one.
    """

    _side: ClassVar[float] = 1.0

    @classmethod
    def probes(cls, scales: Scales, inner: AbstractPart | None) -> tuple[tuple[Self, ...], ...]:
        """Stops at 99 to 80 % of the way that the plain stage goes."""
        lowest_um = scales.middle_um - scales.stroke_um / 2
        return cls._probes(inner, [lowest_um + level * scales.stroke_um for level in _LEVELS])


@register
class LowerEndStop(_AbstractEndStop):
    """A stop below; see `EndStop`.

    Attributes
    ----------
    inner
        The mechanics.
    stop_um
        `x_min`, where the stop begins to touch.
    gain_beyond
        See `EndStop`.
    """

    form: ClassVar[str] = "lower"
    _side: ClassVar[float] = -1.0

    @classmethod
    def probes(cls, scales: Scales, inner: AbstractPart | None) -> tuple[tuple[Self, ...], ...]:
        """Stops at 1 to 20 % of the way that the plain stage goes."""
        highest_um = scales.middle_um + scales.stroke_um / 2
        return cls._probes(inner, [highest_um - level * scales.stroke_um for level in _LEVELS])
