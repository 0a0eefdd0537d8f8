"""Timestamp jitter: samples are not taken when their times say."""

from typing import Any, ClassVar, Self

import numpy as np
from jaxtyping import Array, Float

from microid._in_numpy import _NumpySignal
from microid._linear import Times
from microid._param import param
from microid._part import AbstractPart, Signal
from microid.effects._base import _TIME_STAMPS, AbstractEffect, Place, Scales, Statistic, View, _rate_of, register


@register
class TimestampJitter(AbstractEffect):
    r"""Independent errors of the times with standard deviation `d`, of variance `(y' d)^2`.

    It changes no prediction, but its variance.

    Attributes
    ----------
    jitter_s
        `d`.
    """

    name: ClassVar[str] = "timestamp_jitter"
    takes: ClassVar[str] = "um"
    gives: ClassVar[str] = "um"
    place: ClassVar[Place] = "noise"
    strength: ClassVar[tuple[str, ...]] = ("jitter_s",)
    fingerprint: ClassVar[str] = "The variance of the residual grows with the square of the velocity."
    confusions: ClassVar[tuple[str, ...]] = ("transport_delay", "rate_dependence", "friction")
    experiment: ClassVar[str] = "Raw time stamps, and ramps at three rates."
    source: ClassVar[str] = "1 us with hardware timing to 1 ms with software timing (estimate)"
    view: ClassVar[View] = "velocity"
    column: ClassVar[str] = _TIME_STAMPS
    statistic: ClassVar[Statistic] = "jitter"
    jitter_s: Float[Array, ""] = param(unit="s", scale=1e-4, lower=0.0)

    @classmethod
    def probes(cls, scales: Scales, inner: AbstractPart | None) -> tuple[tuple[Self, ...], ...]:
        """None: noise is told from the residual's spectrum and distribution."""
        return ()

    def run(self, time_s: Times, signal: Signal, start: Any = None) -> Signal:
        """Pass the signal on as it is."""
        return signal

    def in_numpy(self, interval_s: np.ndarray, signal: _NumpySignal) -> _NumpySignal:
        """Pass the signal on as it is."""
        return signal

    def variance_um2(self, time_s: Times, signal: Signal) -> Float[Array, " t"]:
        """Variance that the errors of time add, shape `(t,)`."""
        return (_rate_of(time_s, signal.values) * self.jitter_s) ** 2
