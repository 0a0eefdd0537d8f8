"""Rate-dependent hysteresis: loops that widen with the speed at which they are run through."""

from typing import Any, ClassVar, Self

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from microid._linear import Times
from microid._param import param
from microid._part import AbstractPart, Scene, Signal, innermost
from microid._preisach import Preisach
from microid.densities import AbstractDensity
from microid.effects._base import AbstractEffect, Place, Scales, _lowpass, _rate_of, register
from microid.effects._grids import _decades
from microid.effects._irreversible import _anhysteretic

# By which the widening lags behind the rate: a width that jumped at reversals would be a step in the displacement.
_LAG_S = 2e-3
# So many plays for each level of the density.
_FINER = 3


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


@register
class WideningPlays(AbstractEffect):
    r"""Plays whose thresholds grow with the rate: the operator of Prandtl and Ishlinskii that depends on it.

    A `Preisach` operator is a sum of plays of all half-widths `h`, each behind the density on the relays of that
    width. What their widening changes is added to the displacement:

    .. math:: h \leftarrow h \, (1 + b \log_{10}(1 + \mathrm{LP}_{\tau}[|\dot u|] / v_0))

    Far above the rates of a record the onset `v0` makes that a widening in proportion to the rate. Of another law the
    irreversible part widens so, see `RateDependence`.

    Attributes
    ----------
    inner
        The hysteresis.
    gain_per_decade
        `b`: widening over the width, per decade of the rate.
    onset_V_per_s
        `v0`, where it begins.
    response_s
        `tau`: time that the thresholds take to answer to another rate.
    """

    name: ClassVar[str] = "rate_dependence"
    form: ClassVar[str] = "thresholds"
    takes: ClassVar[str] = "V"
    gives: ClassVar[str] = "um"
    place: ClassVar[Place] = "hysteresis"
    strength: ClassVar[tuple[str, ...]] = ("gain_per_decade",)
    fingerprint: ClassVar[str] = RateDependence.fingerprint
    confusions: ClassVar[tuple[str, ...]] = RateDependence.confusions
    experiment: ClassVar[str] = RateDependence.experiment
    source: ClassVar[str] = "rate-dependent play: Al Janaideh, Rakheja & Su, Mechatronics 19 (2009) 656"
    column: ClassVar[str] = "drive_monitor_V"
    inner: AbstractPart
    gain_per_decade: Float[Array, ""] = param(unit="1", scale=0.05, lower=0.0)
    onset_V_per_s: Float[Array, ""] = param(unit="V/s", scale=100.0, lower=1e-3, upper=1e7)
    response_s: Float[Array, ""] = param(default=2e-3, unit="s", lower=1e-5, upper=1.0)

    @classmethod
    def probes(cls, scales: Scales, inner: AbstractPart | None) -> tuple[tuple[Self, ...], ...]:
        """Onsets at the fastest rate and a tenth and a hundredth of it; thresholds at once and late."""
        if inner is None:
            return ()
        grid = _decades(max(scales.fastest_V_per_s / 100, 1e-2), scales.fastest_V_per_s)
        return tuple(
            (cls(inner, jnp.asarray(0.05), jnp.asarray(onset), jnp.asarray(response)),)
            for response in (max(_LAG_S, 2 * scales.interval_s), 10 * scales.interval_s)
            for onset in grid
        )

    def run(self, time_s: Times, signal: Signal, start: Any = None) -> Signal:
        """Add what the widening of all plays changes."""
        given = self.inner.run(time_s, signal, start)
        if signal.values.shape[0] < 2:
            return given
        speed = _lowpass(time_s, jnp.abs(_rate_of(time_s, signal.values)), self.response_s)
        wider = 1 + self.gain_per_decade * jnp.log1p(speed / self.onset_V_per_s) / jnp.log(10.0)
        law = innermost(self.inner)
        if not isinstance(law, Preisach):
            beside = given.values - _anhysteretic(self.inner, signal, start).values
            return given.with_values(given.values + (wider - 1) * beside, given.before)
        half_V, answer = _plays(law.density)
        memory = start.memory if isinstance(start, Scene) else start
        past = law.density.lower_V[None] if memory is None else memory.extremes_V

        def follow(at: Array, now: tuple[Array, Array]) -> tuple[Array, Array]:
            level, factor = now
            # Those that widen, and the same as they are at rest.
            width = half_V[None] * jnp.stack([factor, jnp.ones_like(factor)])[:, None]
            at = jnp.clip(at, level - width, level + width)
            both = answer(at)
            return at, both[0] - both[1]

        rest = jnp.ones_like(past, shape=past.shape[0] + 1)
        at = jnp.stack([law.density.lower_V + half_V] * 2)
        at, _ = lax.scan(follow, at, (jnp.append(past, signal.before), rest))
        _, more = lax.scan(follow, at, (signal.values, wider))
        return given.with_values(given.values + more, given.before)


def _plays(density: AbstractDensity) -> tuple[Float[Array, " k"], Any]:
    """Half-widths of plays that together are the relays of a density, and their answer.

    That gives displacements, `(r,)` in um, for places `(r, k)` in V.
    The relays of one half-width are one play, and the density over their middles is the slope of what follows it.
    They are taken at a part of the steps of the levels, as each switches many relays at a time.
    """
    nodes = density.nodes_um_per_V2()
    count = _FINER * (nodes.shape[0] - 1) + 1
    corner, side = jnp.diagonal(nodes), jnp.diagonal(nodes, -1)
    # The node below each triangle on the diagonal that makes the bilinear form linear on it.
    nodes = nodes + jnp.diag(corner[:-1] + corner[1:] - side, 1)
    places, levels = np.arange(count) / _FINER, np.arange(nodes.shape[0])
    finer = jnp.asarray(np.maximum(1 - np.abs(places[:, None] - levels), 0), dtype=nodes.dtype)
    fine = finer @ nodes @ finer.T
    k, j = np.arange(count)[:, None], np.arange(count)
    inside = k + j < count
    along = jnp.where(inside, fine[np.minimum(k + j, count - 1), j], 0)
    step = (density.upper_V - density.lower_V) / (count - 1)
    # Of the narrowest and the widest half a step belongs to the range.
    along = along * step**2 * jnp.asarray(np.where(k == 0, 0.5, 1.0), dtype=nodes.dtype)
    pairs = jnp.where(inside[:, 1:], (along[:, :-1] + along[:, 1:]) / 2, 0)
    below = jnp.concatenate([jnp.zeros_like(along[:, :1]), jnp.cumsum(pairs, axis=1)], axis=1)
    middle, last = (jnp.asarray(some[None], dtype=nodes.dtype) for some in (k[:, 0] / 2, count - 1.0 - k[:, 0]))
    first, most = (jnp.asarray(some[None], dtype=jnp.int32) for some in (count * k[:, 0], count - 2 - k[:, 0]))
    ahead = jnp.diff(along, axis=1, append=0) / 2
    pieces = below.ravel(), along.ravel(), ahead.ravel()

    def answer(at_V: Float[Array, "r k"]) -> Float[Array, " r"]:
        x = (at_V - density.lower_V) / step - middle
        x = jnp.where(x > last, last, jnp.where(x < 0, 0, x))
        i = jnp.clip(lax.stop_gradient(x).astype(jnp.int32), 0, jnp.maximum(most, 0))
        share = x - i.astype(x.dtype)
        so_far, here, bend = (one.at[first + i].get(mode="promise_in_bounds") for one in pieces)
        return jnp.sum(so_far + share * (here + share * bend), axis=1)

    return step * jnp.asarray(k[:, 0] / 2, dtype=nodes.dtype), answer
