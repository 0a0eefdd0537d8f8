"""Aging and wake-up: the gain changes with the cycles that the piezo has gone through."""

from typing import Any, ClassVar, Self

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from microid._linear import Times
from microid._param import _as_inexact, param
from microid._part import AbstractPart, Signal
from microid.effects._base import AbstractEffect, Place, Scales, register


@register
class Aging(AbstractEffect):
    r"""A gain that changes along the logarithm of the path of the command.

    .. math:: w_0 + (w - w_0) (1 + a \log_{10}(1 + s / s_0)), \qquad s = \int |du|

    Attributes
    ----------
    gain_per_decade
        `a`: positive for wake-up, negative for aging.
    cycle_V
        `s0`, the path after which it has begun.
    zero_um
        `w0`, the displacement that stays, given.
    """

    name: ClassVar[str] = "aging"
    takes: ClassVar[str] = "um"
    gives: ClassVar[str] = "um"
    place: ClassVar[Place] = "hysteresis"
    strength: ClassVar[tuple[str, ...]] = ("gain_per_decade",)
    fingerprint: ClassVar[str] = (
        "The residual is in proportion to the position, by a factor that grows slowly with the cycles and not with "
        "the time."
    )
    confusions: ClassVar[tuple[str, ...]] = ("thermal_gain", "thermal_drift", "creep", "accommodation")
    experiment: ClassVar[str] = (
        "The same loop at the start, in the middle and at the end, and again after an hour at rest."
    )
    source: ClassVar[str] = (
        "PI piezo tutorial: negligible in actuators, which are poled again in use; 0.1 to 2 % per decade (estimate)"
    )
    gain_per_decade: Float[Array, ""] = param(unit="1", scale=1e-3)
    cycle_V: Float[Array, ""] = param(unit="V", scale=100.0, lower=1e-3)
    zero_um: Float[Array, ""] = eqx.field(converter=_as_inexact, default=0.0)

    @classmethod
    def probes(cls, scales: Scales, inner: AbstractPart | None) -> tuple[tuple[Self, ...], ...]:
        """Paths of 0.3, one and three whole cycles."""
        cycle = 2 * (scales.upper_V - scales.lower_V)
        return tuple((cls(jnp.asarray(1e-3), jnp.asarray(share * cycle)),) for share in (0.3, 1.0, 3.0))

    def run(self, time_s: Times, signal: Signal, start: Any = None) -> Signal:
        """Scale the displacement by what the command has gone through since the first sample."""
        command = start.command.values
        path = jnp.concatenate([jnp.zeros_like(command[:1]), jnp.cumsum(jnp.abs(jnp.diff(command)))])
        more = self.gain_per_decade * jnp.log1p(path / self.cycle_V) / jnp.log(10.0)
        return Signal(signal.values + more * (signal.values - self.zero_um), signal.before, signal.hold)
