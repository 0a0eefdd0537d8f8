"""Quantisation: the converter knows readings of a grid only."""

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
class Quantisation(AbstractEffect):
    r"""Rounding to steps `q`, of variance `q^2 / 12` where other noise exceeds half a step.

    It changes no prediction, but its variance.

    Attributes
    ----------
    step_um
        `q`.
    """

    name: ClassVar[str] = "quantisation"
    takes: ClassVar[str] = "um"
    gives: ClassVar[str] = "um"
    place: ClassVar[Place] = "noise"
    strength: ClassVar[tuple[str, ...]] = ("step_um",)
    fingerprint: ClassVar[str] = (
        "Few distinct readings with a constant gap, and a sawtooth over the position in slow ramps."
    )
    confusions: ClassVar[tuple[str, ...]] = ("backlash", "friction")
    experiment: ClassVar[str] = "A slow ramp, and the same offset by half a step."
    source: ClassVar[str] = "Widrow & Kollar, Quantization Noise, 2008; 16 bits of 5 mm are 76 nm"
    view: ClassVar[View] = "position"
    statistic: ClassVar[Statistic] = "rounding"
    step_um: Float[Array, ""] = param(unit="um", scale=0.1, lower=0.0)

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
        """Variance that rounding adds, shape `(t,)`."""
        return jnp.broadcast_to(self.step_um**2 / 12, signal.values.shape)
