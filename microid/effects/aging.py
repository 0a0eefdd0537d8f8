"""Aging and wake-up: the gain changes with the cycles that the piezo has gone through, or with the time."""

from typing import Any, ClassVar, Self

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from microid._linear import Times
from microid._param import _as_inexact, param
from microid._part import AbstractPart, Signal
from microid.effects._base import AbstractEffect, Place, Scales, View, _times_of, register


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
        "The residual is in proportion to the position, by a factor that grows ever more slowly, with cycles or time."
    )
    confusions: ClassVar[tuple[str, ...]] = (
        "thermal_gain",
        "thermal_drift",
        "creep",
        "accommodation",
        "curved_hysteresis",
    )
    experiment: ClassVar[str] = (
        "The same loop at the start, in the middle and at the end, and again after an hour at rest."
    )
    source: ClassVar[str] = (
        "PI piezo tutorial: negligible in actuators, which are poled again in use; 0.1 to 2 % per decade (estimate)"
    )
    view: ClassVar[View] = "time"
    column: ClassVar[str] = "temperature_degC"
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
        path = _path_V(start.command.values)
        return _scaled(signal, self.gain_per_decade * jnp.log1p(path / self.cycle_V), self.zero_um)


@register
class AgingOverRecords(AbstractEffect):
    """The same with the path of the records before: they follow one another on one stage.

    Attributes
    ----------
    gain_per_decade
        Positive for wake-up, negative for aging.
    cycle_V
        The path after which it has begun.
    zero_um
        The displacement that stays, given.
    """

    name: ClassVar[str] = "aging"
    form: ClassVar[str] = "over_records"
    takes: ClassVar[str] = "um"
    gives: ClassVar[str] = "um"
    place: ClassVar[Place] = "hysteresis"
    strength: ClassVar[tuple[str, ...]] = ("gain_per_decade",)
    needs: ClassVar[tuple[str, ...]] = ("path_V",)
    fingerprint: ClassVar[str] = Aging.fingerprint
    confusions: ClassVar[tuple[str, ...]] = Aging.confusions
    experiment: ClassVar[str] = Aging.experiment
    source: ClassVar[str] = Aging.source
    view: ClassVar[View] = "time"
    column: ClassVar[str] = "temperature_degC"
    gain_per_decade: Float[Array, ""] = param(unit="1", scale=1e-3)
    cycle_V: Float[Array, ""] = param(unit="V", scale=100.0, lower=1e-3)
    zero_um: Float[Array, ""] = eqx.field(converter=_as_inexact, default=0.0)

    @classmethod
    def probes(cls, scales: Scales, inner: AbstractPart | None) -> tuple[tuple[Self, ...], ...]:
        """Paths of 0.3, one and three whole cycles."""
        cycle = 2 * (scales.upper_V - scales.lower_V)
        return tuple((cls(jnp.asarray(1e-3), jnp.asarray(share * cycle)),) for share in (0.3, 1.0, 3.0))

    def run(self, time_s: Times, signal: Signal, start: Any = None) -> Signal:
        """Scale the displacement by what the command has gone through in all records so far.

        Without a column `path_V` that is the path since the first sample.
        """
        path = start.columns.get("path_V", _path_V(start.command.values))
        return _scaled(signal, self.gain_per_decade * jnp.log1p(path / self.cycle_V), self.zero_um)


@register
class AgingOverTime(AbstractEffect):
    r"""A gain that changes along the logarithm of the time, as ceramics age after they were poled.

    .. math:: w_0 + (w - w_0) (1 + a \log_{10}(e^b + t / t_0))

    Attributes
    ----------
    gain_per_decade
        `a`: negative where the gain falls.
    onset_s
        `t0`, how long ago it had begun at the first sample.
    earlier
        `b`: how many e-folds longer ago that was before one record than before others.
    zero_um
        `w0`, the displacement that stays, given.
    """

    name: ClassVar[str] = "aging"
    form: ClassVar[str] = "over_time"
    takes: ClassVar[str] = "um"
    gives: ClassVar[str] = "um"
    place: ClassVar[Place] = "hysteresis"
    strength: ClassVar[tuple[str, ...]] = ("gain_per_decade",)
    history: ClassVar[tuple[str, ...]] = ("earlier",)
    fingerprint: ClassVar[str] = Aging.fingerprint
    confusions: ClassVar[tuple[str, ...]] = Aging.confusions
    experiment: ClassVar[str] = Aging.experiment
    source: ClassVar[str] = "aging of poled ceramics along the logarithm of time; 0.1 to 2 % per decade (estimate)"
    view: ClassVar[View] = "time"
    column: ClassVar[str] = "temperature_degC"
    gain_per_decade: Float[Array, ""] = param(unit="1", scale=1e-3)
    onset_s: Float[Array, ""] = param(unit="s", lower=1e-4, upper=1e6)
    earlier: Float[Array, ""] = param(default=0.0, unit="1")
    zero_um: Float[Array, ""] = eqx.field(converter=_as_inexact, default=0.0)

    @classmethod
    def probes(cls, scales: Scales, inner: AbstractPart | None) -> tuple[tuple[Self, ...], ...]:
        """Onsets in decades, from a hundredth of the longest record to ten of it."""
        onsets = (share * scales.duration_s for share in (0.01, 0.1, 1.0, 10.0))
        return tuple((cls(jnp.asarray(1e-3), jnp.asarray(max(onset, 2e-4))),) for onset in onsets)

    def run(self, time_s: Times, signal: Signal, start: Any = None) -> Signal:
        """Scale the displacement by what time has gone by since the first sample."""
        passed = _times_of(time_s, signal.values.shape[0]) / self.onset_s
        factor = self.gain_per_decade / jnp.log(10.0)
        more = factor * (self.earlier + jnp.log1p(passed * jnp.exp(-self.earlier)))
        before = signal.before + factor * self.earlier * (signal.before - self.zero_um)
        return signal.with_values(signal.values + more * (signal.values - self.zero_um), before)


def _path_V(command_V: Float[Array, " t"]) -> Float[Array, " t"]:
    return jnp.concatenate([jnp.zeros_like(command_V[:1]), jnp.cumsum(jnp.abs(jnp.diff(command_V)))])


def _scaled(signal: Signal, more: Float[Array, " t"], zero_um: Float[Array, ""]) -> Signal:
    factor = more / jnp.log(10.0)
    return signal.with_values(signal.values + factor * (signal.values - zero_um), signal.before)
