"""Voltage-dependent capacitance: the driver's lag changes with the voltage of the piezo."""

from typing import Any, ClassVar, Self

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from microid._linear import Times, _bend
from microid._param import array, param
from microid._part import AbstractPart, Signal, innermost
from microid.effects._base import AbstractEffect, Place, Scales, View, _times_of, register

_CORRECTIONS = 2


@register
class VoltageDependentCapacitance(AbstractEffect):
    r"""A driver whose time constant is a line over the voltage that it gives.

    .. math:: \tau_0 \left(1 + c_1 \frac{v - v_m}{v_h}\right) \dot v + v = k u

    From sample to sample the time constant is that of the middle of the step, found by two corrections.

    Attributes
    ----------
    inner
        The driver, of time constant `tau0` and gain `k`.
    slope
        `c1`: relative change of the time constant over half the range.
    middle_V, half_range_V
        `v_m` and `v_h`, given, of the voltage behind the driver.
    """

    name: ClassVar[str] = "voltage_dependent_capacitance"
    takes: ClassVar[str] = "V"
    gives: ClassVar[str] = "V"
    place: ClassVar[Place] = "driver"
    strength: ClassVar[tuple[str, ...]] = ("slope",)
    fast: ClassVar[bool] = True
    fingerprint: ClassVar[str] = "The residual is the velocity times a factor that changes with the bias."
    confusions: ClassVar[tuple[str, ...]] = (
        "rate_dependence",
        "slew_limit",
        "stiffness_hardening",
        "driver_asymmetry",
    )
    experiment: ClassVar[str] = "Small chirps at four biases, and a monitor of the piezo's voltage."
    source: ClassVar[str] = "Noliac tutorial on heat dissipation; 20 to 50 % over the unipolar range (estimate)"
    view: ClassVar[View] = "velocity"
    column: ClassVar[str] = "drive_monitor_V"
    inner: AbstractPart
    slope: Float[Array, ""] = param(unit="1", scale=0.1, lower=-0.9, upper=0.9)
    middle_V: Float[Array, ""] = array()
    half_range_V: Float[Array, ""] = array()

    @classmethod
    def probes(cls, scales: Scales, inner: AbstractPart | None) -> tuple[tuple[Self, ...], ...]:
        """A change of a tenth over half the range."""
        if inner is None:
            return ()
        gain = innermost(inner).gain
        middle, half = (scales.upper_V + scales.lower_V) / 2, (scales.upper_V - scales.lower_V) / 2
        return ((cls(inner, jnp.asarray(0.1), gain * middle, gain * half),),)

    def run(self, time_s: Times, signal: Signal, start: Any = None) -> Signal:
        """Follow the command; the driver's own answer and what the capacitance adds to it."""
        given = self.inner.run(time_s, signal, start)
        more = self._followed(time_s, signal, self.slope) - self._followed(time_s, signal, jnp.zeros_like(self.slope))
        return given.with_values(given.values + more, given.before)

    def _followed(self, time_s: Times, signal: Signal, slope: Float[Array, ""]) -> Float[Array, " t"]:
        driver = innermost(self.inner)
        first = driver.gain * signal.before
        if signal.values.shape[0] == 1:
            return first[None]
        bend = _bend(time_s, signal.values) if signal.hold == "smooth" else jnp.zeros_like(signal.values)
        target = driver.gain * (signal.values - bend)
        interval = jnp.diff(_times_of(time_s, target.shape[0]))

        def visit(voltage: Array, now: tuple[Array, ...]) -> tuple[Array, Array]:
            old, new, step = now
            later = voltage
            for _ in range(_CORRECTIONS):
                place = ((voltage + later) / 2 - self.middle_V) / self.half_range_V
                # Beyond the range the line could reach zero.
                lag = driver.time_constant_s * (1 + slope * jnp.clip(place, -1, 1)) / step
                left = jnp.exp(-1 / lag)
                rest = old if signal.hold == "zero" else new - lag * (new - old)
                begun = old if signal.hold == "zero" else old - lag * (new - old)
                later = rest + left * (voltage - begun)
            return later, later

        _, voltages = lax.scan(visit, first, (target[:-1], target[1:], interval))
        return jnp.concatenate([first[None], voltages])
