"""Stiffness hardening: flexures that stiffen as they are stretched (Duffing)."""

from typing import Any, ClassVar, Self

import jax.numpy as jnp
from jaxtyping import Array, Float

from microid._linear import Times
from microid._param import array, param
from microid._part import AbstractPart, Signal, innermost
from microid.effects._base import AbstractEffect, Place, Scales, View, register
from microid.effects._oscillator import _braked, _forces_um

_AT_REST = 8


@register
class StiffnessHardening(AbstractEffect):
    r"""A cubic in the restoring force of the mechanics.

    .. math::
        \ddot x + 2 \zeta \omega \dot x + \omega^2 \left[x + \kappa (x - c)^3 / Y^2\right] = \omega^2 \lambda w

    Attributes
    ----------
    inner
        The mechanics.
    hardening
        `kappa`: change of the secant stiffness at half the stroke from the centre; negative where it softens.
    centre_um
        `c`, where the stiffness is least.
    half_stroke_um
        `Y`, given.
    """

    name: ClassVar[str] = "stiffness_hardening"
    takes: ClassVar[str] = "um"
    gives: ClassVar[str] = "um"
    place: ClassVar[Place] = "mechanics"
    strength: ClassVar[tuple[str, ...]] = ("hardening",)
    fast: ClassVar[bool] = True
    fingerprint: ClassVar[str] = "The resonance shifts with the bias and with the amplitude; at rest little is left."
    confusions: ClassVar[tuple[str, ...]] = (
        "sensor_nonlinearity",
        "load_change",
        "second_resonance",
        "voltage_dependent_capacitance",
    )
    experiment: ClassVar[str] = "Small chirps at three biases, and chirps of three amplitudes."
    source: ClassVar[str] = (
        "Duffing; J. Dyn. Sys. Meas. Control 139 (2017) 101001: large above 5 % of the beam's length; 0.01 to 2 % at "
        "full stroke (estimate)"
    )
    view: ClassVar[View] = "frequency"
    inner: AbstractPart
    hardening: Float[Array, ""] = param(unit="1", scale=0.01)
    centre_um: Float[Array, ""] = param(unit="um", scale=10.0)
    half_stroke_um: Float[Array, ""] = array()

    @classmethod
    def probes(cls, scales: Scales, inner: AbstractPart | None) -> tuple[tuple[Self, ...], ...]:
        """Centres at no displacement, at half the stroke and at its end."""
        if scales.resonance_Hz is None or inner is None:
            return ()
        half, size = scales.stroke_um / 2, jnp.asarray(0.002)
        return tuple(
            (cls(inner, size, jnp.asarray(scales.middle_um + share * half), jnp.asarray(half)),)
            for share in (-1.0, 0.0, 1.0)
        )

    def run(self, time_s: Times, signal: Signal, start: Any = None) -> Signal:
        """Let the mechanics answer to what the cubic leaves of the piezo's displacement."""
        mechanics = innermost(self.inner)

        def law(_: Array, there: Array, memory: Any) -> tuple[Array, Any]:
            place = (there - self.centre_um) / self.half_stroke_um
            return self.hardening * self.half_stroke_um * place**3 / mechanics.gain, memory

        before = jnp.zeros_like(signal.before)
        for _ in range(_AT_REST):
            before, _ = law(before, mechanics.gain * (signal.before - before), ())
        taken = _forces_um(mechanics, time_s, signal, law, before, ())
        return _braked(self.inner, time_s, signal, start, taken, before)
