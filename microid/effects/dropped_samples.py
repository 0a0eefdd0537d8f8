"""Dropped samples: from a loss on, readings are of later instants than their times say."""

from typing import Any, ClassVar, Self

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from microid._in_numpy import _instants, _NumpySignal, _reading_at
from microid._linear import Times
from microid._param import param
from microid._part import AbstractPart, Signal
from microid.effects._base import _TIME_STAMPS, AbstractEffect, Place, Scales, View, _times_of, register
from microid.effects._resample import _read_at

_INSTANTS = 12


@register
class DroppedSamples(AbstractEffect):
    r"""One loss: `y(t + d S((t - a) / h))`, with the logistic step `S` and the interval `h`.

    Attributes
    ----------
    dropped_s
        `d`, the time that is missing.
    after_s
        `a`, when it was lost.
    """

    name: ClassVar[str] = "dropped_samples"
    takes: ClassVar[str] = "um"
    gives: ClassVar[str] = "um"
    place: ClassVar[Place] = "time"
    strength: ClassVar[tuple[str, ...]] = ("dropped_s",)
    finite: ClassVar[bool] = True
    per_run: ClassVar[bool] = True
    repeats: ClassVar[bool] = True
    counted: ClassVar[tuple[str, ...]] = ("dropped_s",)
    fingerprint: ClassVar[str] = (
        "The residual is the velocity times a factor that jumps by whole intervals between samples."
    )
    confusions: ClassVar[tuple[str, ...]] = ("clock_mismatch", "transport_delay", "timestamp_jitter")
    experiment: ClassVar[str] = "Raw time stamps or a counter of samples, and a fast ramp throughout."
    source: ClassVar[str] = "losses of up to 0.1 % of the samples under load (estimate)"
    view: ClassVar[View] = "velocity"
    column: ClassVar[str] = _TIME_STAMPS
    dropped_s: Float[Array, ""] = param(unit="s", scale=1e-3, lower=0.0)
    after_s: Float[Array, ""] = param(unit="s", scale=1.0, lower=0.0)

    @classmethod
    def probes(cls, scales: Scales, inner: AbstractPart | None) -> tuple[tuple[Self, ...], ...]:
        """One sample lost at one of twelve instants of the longest record, and of the shortest."""
        lost = jnp.asarray(scales.interval_s)
        each = (np.arange(_INSTANTS) + 0.5) / _INSTANTS
        instants = np.unique(np.outer([scales.shortest_s, scales.duration_s], each))
        return tuple((cls(lost, jnp.asarray(float(instant))),) for instant in instants)

    def run(self, time_s: Times, signal: Signal, start: Any = None) -> Signal:
        """Read the signal at later times after the loss."""
        time = _times_of(time_s, signal.values.shape[0])
        width = time[1] - time[0] if time.shape[0] > 1 else jnp.ones_like(self.after_s)
        when = time + self.dropped_s * jax.nn.sigmoid((time - self.after_s) / width)
        return signal.with_values(_read_at(time_s, signal, when), signal.before)

    def in_numpy(self, interval_s: np.ndarray, signal: _NumpySignal) -> _NumpySignal:
        """Read the signal at later times after the loss."""
        time = _instants(interval_s, len(signal.values))
        lost = 0.5 * (1 + np.tanh((time - self.after_s) / (2 * interval_s[0])))
        return signal._replace(values=_reading_at(interval_s, signal, time + self.dropped_s * lost))
