"""Slew limit: the amplifier's current charges the piezo no faster than it can."""

from typing import Any, ClassVar, Self

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from microid._linear import Times
from microid._param import param
from microid._part import AbstractPart, Signal
from microid.effects._base import AbstractEffect, Place, Scales, _times_of, register


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

        return Signal(lax.scan(visit, signal.before, (signal.values, reach))[1], signal.before, signal.hold)
