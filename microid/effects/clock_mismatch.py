"""Clock mismatch: the clocks of the generator and of the recorder run at different rates."""

from typing import Any, ClassVar, Self

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from microid._in_numpy import _instants, _NumpySignal, _reading_at
from microid._linear import Times
from microid._param import param
from microid._part import AbstractPart, Signal
from microid.effects._base import _TIME_STAMPS, AbstractEffect, Place, Scales, View, _times_of, register
from microid.effects._resample import _read_at


@register
class ClockMismatch(AbstractEffect):
    r"""A reading whose time runs ahead or falls behind: `y(t (1 + p / 10^6))`, from the start of the record.

    Attributes
    ----------
    rate_ppm
        `p`; at the end of the record, the reading stays what it is last.
    """

    name: ClassVar[str] = "clock_mismatch"
    takes: ClassVar[str] = "um"
    gives: ClassVar[str] = "um"
    place: ClassVar[Place] = "time"
    strength: ClassVar[tuple[str, ...]] = ("rate_ppm",)
    fingerprint: ClassVar[str] = "The residual is the velocity times a factor that grows in a line with the time."
    confusions: ClassVar[tuple[str, ...]] = ("transport_delay", "dropped_samples", "timestamp_jitter")
    experiment: ClassVar[str] = "A long record of a fast ramp that is repeated, with the time stamps of both clocks."
    source: ClassVar[str] = "quartz clocks differ by 10 to 200 ppm (estimate)"
    view: ClassVar[View] = "velocity"
    column: ClassVar[str] = _TIME_STAMPS
    rate_ppm: Float[Array, ""] = param(unit="ppm", scale=100.0)

    @classmethod
    def probes(cls, scales: Scales, inner: AbstractPart | None) -> tuple[tuple[Self, ...], ...]:
        """Half the interval between samples at the end of the longest record."""
        return ((cls(jnp.asarray(0.5e6 * scales.interval_s / scales.duration_s)),),)

    def run(self, time_s: Times, signal: Signal, start: Any = None) -> Signal:
        """Read the signal at the times of the other clock."""
        when = _times_of(time_s, signal.values.shape[0]) * (1 + 1e-6 * self.rate_ppm)
        return signal.with_values(_read_at(time_s, signal, when), signal.before)

    def in_numpy(self, interval_s: np.ndarray, signal: _NumpySignal) -> _NumpySignal:
        """Read the signal at the times of the other clock."""
        when = _instants(interval_s, len(signal.values)) * (1 + 1e-6 * self.rate_ppm)
        return signal._replace(values=_reading_at(interval_s, signal, when))
