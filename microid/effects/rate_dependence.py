"""Rate-dependent hysteresis: loops that widen with the speed at which they are run through."""

from typing import Any, ClassVar, Self

import jax.numpy as jnp
from jaxtyping import Array, Float

from microid._linear import Times
from microid._param import param
from microid._part import AbstractPart, Signal, innermost
from microid._preisach import Preisach
from microid.effects._base import AbstractEffect, Place, Scales, _lowpass, _rate_of, register
from microid.effects._grids import _decades
from microid.effects._irreversible import _anhysteretic

# By which the widening lags behind the rate: a width that jumped at reversals would be a step in the displacement.
_LAG_S = 2e-3


@register
class RateDependence(AbstractEffect):
    r"""A loop that widens along the logarithm of the rate.

    .. math:: w + b \, \mathrm{LP}_{2 ms}[\log_{10}(1 + |\dot u| / v_0)] \, w_{irr}

    The irreversible part is the displacement less the mean of the two branches of the loop over the record's range.

    Attributes
    ----------
    inner
        The hysteresis.
    gain_per_decade
        `b`: widening over the loop's width, per decade of the rate.
    onset_V_per_s
        `v0`, where it begins.
    """

    name: ClassVar[str] = "rate_dependence"
    takes: ClassVar[str] = "V"
    gives: ClassVar[str] = "um"
    place: ClassVar[Place] = "hysteresis"
    strength: ClassVar[tuple[str, ...]] = ("gain_per_decade",)
    fingerprint: ClassVar[str] = (
        "Over the voltage the residual is a thin loop whose area grows along the logarithm of the rate, in "
        "proportion to the width of the hysteresis and not to the stroke; it is gone in slow loops."
    )
    confusions: ClassVar[tuple[str, ...]] = (
        "transport_delay",
        "sensor_lowpass",
        "slew_limit",
        "creep",
        "voltage_dependent_capacitance",
    )
    experiment: ClassVar[str] = (
        "The same levels at three rates or more over two decades, and small and large amplitudes at the same speed."
    )
    source: ClassVar[str] = (
        "Robert, Damjanovic & Setter, J. Appl. Phys. 90 (2001) 2459; Wolf, Sutor, Rupitsch & Lerch, Sens. Actuators "
        "A 172 (2011) 245; 2 to 10 % of the width per decade (estimate)"
    )
    column: ClassVar[str] = "drive_monitor_V"
    inner: AbstractPart
    gain_per_decade: Float[Array, ""] = param(unit="1", scale=0.05, lower=0.0)
    onset_V_per_s: Float[Array, ""] = param(unit="V/s", scale=100.0, lower=1e-3, upper=1e7)

    @classmethod
    def probes(cls, scales: Scales, inner: AbstractPart | None) -> tuple[tuple[Self, ...], ...]:
        """Onsets in steps of a decade, down to a thousandth of the fastest rate."""
        if inner is None:
            return ()
        grid = _decades(max(scales.fastest_V_per_s / 1000, 1e-2), scales.fastest_V_per_s)
        return tuple((cls(inner, jnp.asarray(0.05), jnp.asarray(onset)),) for onset in grid)

    def run(self, time_s: Times, signal: Signal, start: Any = None) -> Signal:
        """Widen the loop."""
        given = self.inner.run(time_s, signal, start)
        if signal.values.shape[0] < 2:
            return given
        beside = given.values - _anhysteretic(self.inner, signal, start).values
        speed = jnp.log1p(jnp.abs(_rate_of(time_s, signal.values)) / self.onset_V_per_s) / jnp.log(10.0)
        wider = _lowpass(time_s, speed, jnp.asarray(_LAG_S, dtype=speed.dtype))
        return given.with_values(given.values + self.gain_per_decade * wider * beside, given.before)


@register
class RelaxingHysteresis(AbstractEffect):
    r"""A share of the irreversible part that lags: `w + g (LP_tau[w_irr] - w_irr)`.

    Attributes
    ----------
    inner
        The hysteresis.
    share
        `g`.
    time_constant_s
        `tau`.
    """

    name: ClassVar[str] = "rate_dependence"
    form: ClassVar[str] = "relaxation"
    takes: ClassVar[str] = "V"
    gives: ClassVar[str] = "um"
    place: ClassVar[Place] = "hysteresis"
    strength: ClassVar[tuple[str, ...]] = ("share",)
    fingerprint: ClassVar[str] = RateDependence.fingerprint
    confusions: ClassVar[tuple[str, ...]] = RateDependence.confusions
    experiment: ClassVar[str] = RateDependence.experiment
    source: ClassVar[str] = RateDependence.source
    column: ClassVar[str] = "drive_monitor_V"
    inner: AbstractPart
    share: Float[Array, ""] = param(unit="1", scale=0.1, lower=0.0)
    time_constant_s: Float[Array, ""] = param(unit="s", scale=0.01, lower=1e-6, upper=1e3)

    @classmethod
    def probes(cls, scales: Scales, inner: AbstractPart | None) -> tuple[tuple[Self, ...], ...]:
        """Time constants in steps of a decade, from some samples to a tenth of a second or three samples more."""
        if inner is None:
            return ()
        first = max(3 * scales.interval_s, 3e-4)
        grid = _decades(first, max(0.1, 10 * first))
        return tuple((cls(inner, jnp.asarray(0.1), jnp.asarray(constant)),) for constant in grid)

    def run(self, time_s: Times, signal: Signal, start: Any = None) -> Signal:
        """Let a share of the irreversible part come late."""
        given = self.inner.run(time_s, signal, start)
        beside = given.values - _anhysteretic(self.inner, signal, start).values
        late = _lowpass(time_s, beside, self.time_constant_s)
        return given.with_values(given.values + self.share * (late - beside), given.before)


@register
class ActivatedSwitching(AbstractEffect):
    r"""Relays that switch the later, the faster the voltage: thermally activated walls (Eyring's law).

    .. math:: u \leftarrow u - v \, \mathrm{asinh}(\mathrm{LP}_{\tau}[\dot u] / r)

    The memoryless part of a `Preisach` hysteresis follows at once.

    Attributes
    ----------
    inner
        The hysteresis.
    lag_V
        `v`: lag of the switching voltages.
    onset_V_per_s
        `r`: below it the lag is in proportion to the rate, above it to its logarithm.
    response_s
        `tau`: time that the walls take to answer to another rate.
    """

    name: ClassVar[str] = "rate_dependence"
    form: ClassVar[str] = "activated"
    takes: ClassVar[str] = "V"
    gives: ClassVar[str] = "um"
    place: ClassVar[Place] = "hysteresis"
    strength: ClassVar[tuple[str, ...]] = ("lag_V",)
    fingerprint: ClassVar[str] = RateDependence.fingerprint
    confusions: ClassVar[tuple[str, ...]] = RateDependence.confusions
    experiment: ClassVar[str] = RateDependence.experiment
    source: ClassVar[str] = "thermally activated domain walls, a law of Eyring's kind; onsets are estimates"
    column: ClassVar[str] = "drive_monitor_V"
    inner: AbstractPart
    lag_V: Float[Array, ""] = param(unit="V", scale=0.1, lower=0.0)
    onset_V_per_s: Float[Array, ""] = param(unit="V/s", scale=10.0, lower=1e-3, upper=1e7)
    response_s: Float[Array, ""] = param(default=2e-4, unit="s", lower=1e-5, upper=0.1)

    @classmethod
    def probes(cls, scales: Scales, inner: AbstractPart | None) -> tuple[tuple[Self, ...], ...]:
        """Onsets in steps of a decade, down to a ten-thousandth of the fastest rate; walls at once and late."""
        if inner is None:
            return ()
        grid = _decades(max(scales.fastest_V_per_s / 10000, 1e-2), scales.fastest_V_per_s / 3)
        return tuple(
            (cls(inner, jnp.asarray(0.1), jnp.asarray(onset), jnp.asarray(response)),)
            for response in (scales.interval_s / 3, max(_LAG_S, 2 * scales.interval_s))
            for onset in grid
        )

    def run(self, time_s: Times, signal: Signal, start: Any = None) -> Signal:
        """Let the hysteresis see a voltage that stays behind."""
        if signal.values.shape[0] < 2:
            return self.inner.run(time_s, signal, start)
        rate = _lowpass(time_s, _rate_of(time_s, signal.values), self.response_s)
        behind = signal.values - self.lag_V * jnp.arcsinh(rate / self.onset_V_per_s)
        given = self.inner.run(time_s, signal.with_values(behind, signal.before), start)
        law = innermost(self.inner)
        if not isinstance(law, Preisach):
            return given
        # What has no loop has no walls that could be late.
        memoryless = law.reversible(signal.values) - law.reversible(behind)
        return given.with_values(given.values + memoryless, given.before)
