"""Transport delay: the reading is of an earlier instant."""

from typing import Any, ClassVar, Self

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from microid._in_numpy import _instants, _NumpySignal, _reading_at
from microid._linear import Times
from microid._param import param
from microid._part import AbstractPart, Signal
from microid.effects._base import AbstractEffect, Place, Scales, View, _times_of, register
from microid.effects._resample import _read_at


@register
class TransportDelay(AbstractEffect):
    r"""A delay of any length: `y(t - d)`, by cubics through the samples.

    Attributes
    ----------
    delay_s
        `d`.
    before_um_per_s
        Velocity before the first sample.
    """

    name: ClassVar[str] = "transport_delay"
    takes: ClassVar[str] = "um"
    gives: ClassVar[str] = "um"
    place: ClassVar[Place] = "time"
    strength: ClassVar[tuple[str, ...]] = ("delay_s",)
    history: ClassVar[tuple[str, ...]] = ("before_um_per_s",)
    fingerprint: ClassVar[str] = (
        "The residual is minus the velocity times a constant at all amplitudes: the phase falls in a line with the "
        "frequency, and the magnitude stays."
    )
    confusions: ClassVar[tuple[str, ...]] = ("sensor_lowpass", "rate_dependence", "second_resonance")
    experiment: ClassVar[str] = "A small broadband signal up to several times the first resonance."
    source: ClassVar[str] = "dead time exp(-s d); 0.05 to 5 ms in controllers, 1 to 20 ms in polled loops (estimate)"
    view: ClassVar[View] = "velocity"
    column: ClassVar[str] = "drive_monitor_V"
    delay: ClassVar[str] = "delay_s"
    delay_s: Float[Array, ""] = param(unit="s", scale=1e-3, lower=0.0)
    before_um_per_s: Float[Array, ""] = param(default=0.0, unit="um/s")

    @classmethod
    def probes(cls, scales: Scales, inner: AbstractPart | None) -> tuple[tuple[Self, ...], ...]:
        """Half the interval between samples."""
        return ((cls(jnp.asarray(scales.interval_s / 2)),),)

    def run(self, time_s: Times, signal: Signal, start: Any = None) -> Signal:
        """Read the signal as it was before."""
        time = _times_of(time_s, signal.values.shape[0])
        when = time - self.delay_s
        # Beside what was there before, the signal starts from rest.
        rest = signal.values - self.before_um_per_s * time
        read = _read_at(time_s, signal.with_values(rest, signal.before), when)
        return signal.with_values(read + self.before_um_per_s * when, signal.before)

    def in_numpy(self, interval_s: np.ndarray, signal: _NumpySignal) -> _NumpySignal:
        """Read the signal as it was before."""
        when = _instants(interval_s, len(signal.values)) - self.delay_s
        return signal._replace(values=_reading_at(interval_s, signal, when))
