"""Sensor low-pass: the electronics of the sensor follow the displacement with a lag."""

from typing import Any, ClassVar, Self

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from microid._in_numpy import _decay, _NumpySignal, _sag
from microid._linear import Times, _bend, recur
from microid._param import param
from microid._part import AbstractPart, Signal
from microid.effects._base import AbstractEffect, Place, Scales, View, _times_of, register

# Of the interval: of what is faster nothing is left after one sample.
_INSTANT = 0.01


@register
class SensorLowpass(AbstractEffect):
    r"""A lag of the first order, `tau y' + y = x`, regular where it vanishes.

    Exact for signals in lines. A smooth one is followed to the fourth order of the interval if the lag is longer than
    that, and what a shorter lag changes is right to the second: lines through the samples lie beside the signal by
    `b = h^2 x'' / 12` on average, which the lag removes up to the share `1 - c` that is left at the samples,
    `c = 6 q coth(1 / 2 q) - 12 q^2` with `q = tau / h`.

    Attributes
    ----------
    time_constant_s
        `tau`.
    before_um
        By how much the reading is ahead of the displacement at the first sample, since it moved before.
    """

    name: ClassVar[str] = "sensor_lowpass"
    takes: ClassVar[str] = "um"
    gives: ClassVar[str] = "um"
    place: ClassVar[Place] = "sensor"
    strength: ClassVar[tuple[str, ...]] = ("time_constant_s",)
    history: ClassVar[tuple[str, ...]] = ("before_um",)
    fingerprint: ClassVar[str] = (
        "The residual is minus the velocity times a constant, and the magnitude rolls off; so does the noise, at the "
        "same corner."
    )
    confusions: ClassVar[tuple[str, ...]] = ("transport_delay", "rate_dependence", "second_resonance")
    experiment: ClassVar[str] = "A broadband signal beyond the corner, and a monitor of the piezo's voltage."
    source: ClassVar[str] = "first-order lag; corners of 10 Hz to 10 kHz in capacitive controllers (estimate)"
    view: ClassVar[View] = "velocity"
    column: ClassVar[str] = "drive_monitor_V"
    lag: ClassVar[str] = "time_constant_s"
    time_constant_s: Float[Array, ""] = param(unit="s", scale=1e-3, lower=0.0)
    before_um: Float[Array, ""] = param(default=0.0, unit="um")

    @classmethod
    def probes(cls, scales: Scales, inner: AbstractPart | None) -> tuple[tuple[Self, ...], ...]:
        """A half, two and eight intervals between samples."""
        return tuple((cls(jnp.asarray(share * scales.interval_s)),) for share in (0.5, 2.0, 8.0))

    def run(self, time_s: Times, signal: Signal, start: Any = None) -> Signal:
        """Follow the signal; one that jumps at the first sample has done so one interval before."""
        if signal.values.shape[0] == 1:
            return signal
        interval = jnp.diff(_times_of(time_s, signal.values.shape[0]))
        lag = self.time_constant_s / interval
        slow = jnp.maximum(lag, _INSTANT)
        left = jnp.exp(-1 / slow)
        smooth = signal.hold == "smooth"
        bend = _bend(time_s, signal.values) if smooth else jnp.zeros_like(signal.values)
        change = jnp.diff(signal.values - bend)
        # In steps the whole change comes with the sample; in lines it has had its interval.
        push = -change * (left if signal.hold == "zero" else lag * (1 - left))
        first = (signal.before - signal.values[0]) * left[0]
        push = jnp.concatenate([first[None], push])
        behind = recur(jnp.concatenate([left[:1], left])[:, None, None], push[:, None])[:, 0]
        begun = self.before_um * jnp.cumprod(jnp.concatenate([jnp.ones_like(left[:1]), left]))
        passed = 6 * lag / jnp.tanh(0.5 / slow) - 12 * lag**2
        bent = bend * jnp.concatenate([passed[:1], passed])
        after = "first" if signal.hold == "zero" else signal.hold
        return Signal(signal.values + behind + begun - bent, signal.before, after)

    def in_numpy(self, interval_s: np.ndarray, signal: _NumpySignal) -> _NumpySignal:
        """Follow the signal, as `run` does."""
        if len(signal.values) == 1:
            return signal
        lag: Any = (self.time_constant_s / interval_s)[:, None]
        left = np.exp(-1 / np.where(lag.real > _INSTANT, lag, _INSTANT))
        bent = _sag(interval_s, signal.values) if signal.hold == "smooth" else np.zeros_like(signal.values)
        change = np.diff(signal.values - bent, axis=0)
        push = -change * (left if signal.hold == "zero" else lag * (1 - left))
        first = (signal.before - signal.values[0]) * left[0]
        step = left if len(left) == 1 else np.concatenate([left[:1], left])
        behind = _decay(step, np.concatenate([first[None], push]))
        passed = 6 * lag / np.tanh(0.5 / np.where(lag.real > _INSTANT, lag, _INSTANT)) - 12 * lag**2
        passed = passed if len(passed) == 1 else np.concatenate([passed[:1], passed])
        after = "first" if signal.hold == "zero" else signal.hold
        return _NumpySignal(signal.values + behind - bent * passed, signal.before, after)
