"""Driver asymmetry: an amplifier that charges the piezo at another rate than it discharges it."""

from typing import Any, ClassVar, Self

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from microid._linear import Times, _bend
from microid._param import param
from microid._part import AbstractPart, Signal, innermost
from microid.effects._base import AbstractEffect, Place, Scales, View, _times_of, register


@register
class DriverAsymmetry(AbstractEffect):
    r"""A driver whose time constant is another while its voltage rises than while it falls.

    .. math:: \tau_0 \left(1 + a\, \mathrm{sgn}(k u - v)\right) \dot v + v = k u

    Along a line of the command it is exact: the voltage meets the command once at most, and turns there.

    Attributes
    ----------
    inner
        The driver, of time constant `tau0` and gain `k`.
    asymmetry
        `a`: positive where it rises more slowly than it falls.
    """

    name: ClassVar[str] = "driver_asymmetry"
    takes: ClassVar[str] = "V"
    gives: ClassVar[str] = "V"
    place: ClassVar[Place] = "driver"
    strength: ClassVar[tuple[str, ...]] = ("asymmetry",)
    fast: ClassVar[bool] = True
    fingerprint: ClassVar[str] = (
        "The residual is the velocity times a factor that has one sign while the voltage rises and the other while "
        "it falls, at any bias."
    )
    confusions: ClassVar[tuple[str, ...]] = ("voltage_dependent_capacitance", "slew_limit", "rate_dependence")
    experiment: ClassVar[str] = (
        "Equal steps up and down between the same levels, and a monitor of the piezo's voltage."
    )
    source: ClassVar[str] = (
        "unequal source and sink impedance of an output stage, as where a resistor discharges what a transistor "
        "charges; 5 to 20 % (estimate)"
    )
    view: ClassVar[View] = "velocity"
    column: ClassVar[str] = "drive_monitor_V"
    inner: AbstractPart
    asymmetry: Float[Array, ""] = param(unit="1", scale=0.1, lower=-0.9, upper=0.9)

    @classmethod
    def probes(cls, scales: Scales, inner: AbstractPart | None) -> tuple[tuple[Self, ...], ...]:
        """A tenth."""
        return () if inner is None else ((cls(inner, jnp.asarray(0.1)),),)

    def run(self, time_s: Times, signal: Signal, start: Any = None) -> Signal:
        """Follow the command; the driver's own answer and what the asymmetry adds to it."""
        given = self.inner.run(time_s, signal, start)
        if signal.values.shape[0] == 1:
            return given
        more = self._followed(time_s, signal, self.asymmetry)
        more = more - self._followed(time_s, signal, jnp.zeros_like(self.asymmetry))
        return given.with_values(given.values + more, given.before)

    def _followed(self, time_s: Times, signal: Signal, asymmetry: Float[Array, ""]) -> Float[Array, " t"]:
        driver = innermost(self.inner)
        bend = _bend(time_s, signal.values) if signal.hold == "smooth" else jnp.zeros_like(signal.values)
        target = driver.gain * (signal.values - bend)
        interval = jnp.diff(_times_of(time_s, target.shape[0]))
        rise = jnp.zeros_like(interval) if signal.hold == "zero" else jnp.diff(target) / interval

        def visit(voltage: Array, now: tuple[Array, ...]) -> tuple[Array, Array]:
            begun, slope, length = now
            # How far the command is ahead, and where a line leaves it in the end.
            ahead = begun - voltage
            lag = driver.time_constant_s * (1 + asymmetry * jnp.sign(ahead))
            meets = ahead * slope < 0
            share = jnp.where(meets, slope * lag / jnp.where(meets, slope * lag - ahead, 1), 1)
            met = jnp.where(meets, -lag * jnp.log(share), length)
            meets = met < length
            other = driver.time_constant_s * (1 + asymmetry * jnp.sign(slope))
            lag = jnp.where(ahead == 0, other, lag)
            along = slope * lag + (ahead - slope * lag) * jnp.exp(-length / lag)
            beyond = -slope * other * jnp.expm1(-jnp.where(meets, length - met, 0) / other)
            later = begun + slope * length - jnp.where(meets, beyond, along)
            return later, later

        first = driver.gain * signal.before
        _, voltages = lax.scan(visit, first, (target[:-1], rise, interval))
        return jnp.concatenate([first[None], voltages])
