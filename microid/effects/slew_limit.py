"""Slew limit: the amplifier's current charges the piezo no faster than it can."""

from typing import Any, ClassVar, Self

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from microid._linear import Times
from microid._param import param
from microid._part import AbstractPart, Signal, innermost
from microid.effects._base import AbstractEffect, Place, Scales, View, _times_of, register


@register
class SlewLimit(AbstractEffect):
    r"""A voltage that follows the command no faster than `S = I / C`.

    .. math:: v_k = v_{k-1} + \mathrm{clip}(u_k - v_{k-1}, -S h_k, S h_k)

    Exact for a command in lines but for intervals in which it is caught up with and lost again. There is no strength:
    the effect vanishes as the limit grows, and wholly so at the fastest rate of the command.

    Attributes
    ----------
    limit_V_per_s
        `S`, of the command.
    """

    name: ClassVar[str] = "slew_limit"
    takes: ClassVar[str] = "V"
    gives: ClassVar[str] = "V"
    place: ClassVar[Place] = "driver"
    strength: ClassVar[tuple[str, ...]] = ()
    finite: ClassVar[bool] = True
    fingerprint: ClassVar[str] = (
        "The residual appears only in large fast moves, as triangles in time that last in proportion to the height "
        "of the step."
    )
    confusions: ClassVar[tuple[str, ...]] = (
        "rate_dependence",
        "voltage_dependent_capacitance",
        "sensor_nonlinearity",
        "backlash",
    )
    experiment: ClassVar[str] = "Steps of three heights, and a small chirp up to the same frequencies."
    source: ClassVar[str] = "Thorlabs piezo driver bandwidth tutorial: slew rate I_max / C, 5 to 150 V/ms"
    view: ClassVar[View] = "velocity"
    column: ClassVar[str] = "drive_monitor_V"
    limit_V_per_s: Float[Array, ""] = param(unit="V/s", scale=1e4, lower=0.0)

    @classmethod
    def probes(cls, scales: Scales, inner: AbstractPart | None) -> tuple[tuple[Self, ...], ...]:
        """Limits of 85, 60, 40 and 25 % of the command's fastest rate."""
        return tuple((cls(jnp.asarray(share * scales.fastest_V_per_s)),) for share in (0.85, 0.6, 0.4, 0.25))

    def run(self, time_s: Times, signal: Signal, start: Any = None) -> Signal:
        """Follow the command as fast as can be; one that jumps at the first sample has had one interval for it."""
        if signal.values.shape[0] == 1:
            return signal
        interval = jnp.diff(_times_of(time_s, signal.values.shape[0]))
        reach = self.limit_V_per_s * jnp.concatenate([interval[:1], interval])

        def visit(before: Array, now: tuple[Array, Array]) -> tuple[Array, Array]:
            target, most = now
            after = jnp.clip(target, before - most, before + most)
            return after, after

        return signal.with_values(lax.scan(visit, signal.before, (signal.values, reach))[1], signal.before)


@register
class CurrentLimit(AbstractEffect):
    r"""A driver whose current, and with it the rate of the voltage that it gives, is limited.

    .. math:: \dot v = \mathrm{clip}\left(\frac{k u - v}{\tau}, -S, S\right)

    From sample to sample the driver's own answer to a line, no farther than the limit allows.

    Attributes
    ----------
    inner
        The driver, of time constant `tau` and gain `k`.
    limit_V_per_s
        `S`, of the voltage behind the driver.
    """

    name: ClassVar[str] = "slew_limit"
    form: ClassVar[str] = "current"
    takes: ClassVar[str] = "V"
    gives: ClassVar[str] = "V"
    place: ClassVar[Place] = "driver"
    strength: ClassVar[tuple[str, ...]] = ()
    finite: ClassVar[bool] = True
    fast: ClassVar[bool] = True
    fingerprint: ClassVar[str] = SlewLimit.fingerprint
    confusions: ClassVar[tuple[str, ...]] = SlewLimit.confusions
    experiment: ClassVar[str] = SlewLimit.experiment
    source: ClassVar[str] = SlewLimit.source
    view: ClassVar[View] = "velocity"
    column: ClassVar[str] = "drive_monitor_V"
    inner: AbstractPart
    limit_V_per_s: Float[Array, ""] = param(unit="V/s", scale=1e4, lower=0.0)

    @classmethod
    def probes(cls, scales: Scales, inner: AbstractPart | None) -> tuple[tuple[Self, ...], ...]:
        """Limits of 85, 60, 40 and 25 % of the fastest rate that the driver could reach."""
        if inner is None:
            return ()
        lag = innermost(inner).time_constant_s
        steep = (scales.upper_V - scales.lower_V) / jnp.maximum(lag, scales.interval_s)
        fastest = innermost(inner).gain * jnp.minimum(scales.fastest_V_per_s, steep)
        return tuple((cls(inner, share * fastest),) for share in (0.85, 0.6, 0.4, 0.25))

    def run(self, time_s: Times, signal: Signal, start: Any = None) -> Signal:
        """Follow the command; the driver's own answer and what the limit takes from it."""
        given = self.inner.run(time_s, signal, start)
        if signal.values.shape[0] == 1:
            return given
        limited, free = (self._followed(time_s, signal, limit) for limit in (self.limit_V_per_s, jnp.inf))
        return given.with_values(given.values + limited - free, given.before)

    def _followed(self, time_s: Times, signal: Signal, limit: Any) -> Float[Array, " t"]:
        driver = innermost(self.inner)
        target = driver.gain * signal.values
        interval = jnp.diff(_times_of(time_s, target.shape[0]))

        def visit(voltage: Array, now: tuple[Array, ...]) -> tuple[Array, Array]:
            old, new, step = now
            lag = driver.time_constant_s / step
            late = jnp.zeros_like(old) if signal.hold == "zero" else lag * (new - old)
            rest, begun = (old, old) if signal.hold == "zero" else (new - late, old - late)
            free = rest + jnp.exp(-1 / lag) * (voltage - begun)
            after = jnp.clip(free, voltage - limit * step, voltage + limit * step)
            return after, after

        first = driver.gain * signal.before
        _, voltages = lax.scan(visit, first, (target[:-1], target[1:], interval))
        return jnp.concatenate([first[None], voltages])
