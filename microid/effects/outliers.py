"""Outliers: single readings that are far off."""

from typing import Any, ClassVar, Self

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from microid._in_numpy import _NumpySignal
from microid._linear import Times
from microid._param import param
from microid._part import AbstractPart, Signal
from microid.effects._base import AbstractEffect, Place, Scales, Statistic, View, register


@register
class Outliers(AbstractEffect):
    r"""A share `p` of the readings with a further error of standard deviation `s`: variance `p s^2`.

    It changes no prediction, but its variance.

    Attributes
    ----------
    fraction
        `p`.
    size_um
        `s`.
    """

    name: ClassVar[str] = "outliers"
    takes: ClassVar[str] = "um"
    gives: ClassVar[str] = "um"
    place: ClassVar[Place] = "noise"
    strength: ClassVar[tuple[str, ...]] = ("fraction",)
    fingerprint: ClassVar[str] = "Heavy tails: one to three samples far off, without any relation to the command."
    confusions: ClassVar[tuple[str, ...]] = ("dropped_samples", "mains_hum")
    experiment: ClassVar[str] = "The same record twice."
    source: ClassVar[str] = "Tukey 1960, contaminated normal distribution; up to 0.1 % of the samples (estimate)"
    view: ClassVar[View] = "time"
    statistic: ClassVar[Statistic] = "spikes"
    fraction: Float[Array, ""] = param(unit="1", scale=1e-3, lower=0.0, upper=1.0)
    size_um: Float[Array, ""] = param(unit="um", lower=0.0)

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
        """Variance that outliers add on average, shape `(t,)`."""
        return jnp.broadcast_to(self.fraction * self.size_um**2, signal.values.shape)
