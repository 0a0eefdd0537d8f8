"""Repeated readings: where a sample is lost, the reading before it is written down again."""

from typing import Any, ClassVar, Self

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from microid._in_numpy import _NumpySignal
from microid._linear import Times
from microid._param import param
from microid._part import AbstractPart, Signal
from microid.effects._base import _TIME_STAMPS, AbstractEffect, Place, Scales, Statistic, View, register


@register
class RepeatedReadings(AbstractEffect):
    r"""A share `p` of the samples lost one by one: on average they add the variance `p (y_k - y_{k-1})^2`.

    It changes no prediction, but its variance.

    Attributes
    ----------
    fraction
        `p`.
    """

    name: ClassVar[str] = "repeated_readings"
    takes: ClassVar[str] = "um"
    gives: ClassVar[str] = "um"
    place: ClassVar[Place] = "noise"
    strength: ClassVar[tuple[str, ...]] = ("fraction",)
    fingerprint: ClassVar[str] = "Readings that are the one before them to the last digit, while the stage moves on."
    confusions: ClassVar[tuple[str, ...]] = ("outliers", "dropped_samples", "quantisation")
    experiment: ClassVar[str] = "A counter of samples beside the readings, which stands still where one is lost."
    source: ClassVar[str] = "sample and hold of the last value where a bus or a buffer delivers no new one (estimate)"
    view: ClassVar[View] = "time"
    column: ClassVar[str] = _TIME_STAMPS
    statistic: ClassVar[Statistic] = "repeats"
    fraction: Float[Array, ""] = param(unit="1", scale=1e-3, lower=0.0, upper=1.0)

    @classmethod
    def probes(cls, scales: Scales, inner: AbstractPart | None) -> tuple[tuple[Self, ...], ...]:
        """None: it is told from the last digits of the readings."""
        return ()

    def run(self, time_s: Times, signal: Signal, start: Any = None) -> Signal:
        """Pass the signal on as it is."""
        return signal

    def in_numpy(self, interval_s: np.ndarray, signal: _NumpySignal) -> _NumpySignal:
        """Pass the signal on as it is."""
        return signal

    def variance_um2(self, time_s: Times, signal: Signal) -> Float[Array, " t"]:
        """Variance that lost samples add on average, shape `(t,)`."""
        return self.fraction * jnp.diff(signal.values, prepend=signal.values[:1]) ** 2
