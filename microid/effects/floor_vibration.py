"""Floor vibration: noise in a narrow band."""

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
class FloorVibration(AbstractEffect):
    r"""Random oscillation around a frequency `f` with a quality `Q`, of standard deviation `s`.

    It changes no prediction, but its variance.

    Attributes
    ----------
    amplitude_um
        `s`.
    frequency_Hz
        `f`.
    quality
        `Q`: the band is `f / Q` wide at half its power.
    """

    name: ClassVar[str] = "floor_vibration"
    takes: ClassVar[str] = "um"
    gives: ClassVar[str] = "um"
    place: ClassVar[Place] = "noise"
    strength: ClassVar[tuple[str, ...]] = ("amplitude_um",)
    fingerprint: ClassVar[str] = "A peak in the spectrum of the residual, also at rest, whatever the command."
    confusions: ClassVar[tuple[str, ...]] = ("mains_hum", "second_resonance")
    experiment: ClassVar[str] = "A record at rest, and an accelerometer on the floor."
    source: ClassVar[str] = (
        "Acentech note on VC curves: 3 to 50 um/s rms on the floor, of which 1 to 10 nm reach the sensor (estimate)"
    )
    view: ClassVar[View] = "frequency"
    column: ClassVar[str] = "other_um"
    statistic: ClassVar[Statistic] = "band"
    amplitude_um: Float[Array, ""] = param(unit="um", scale=0.01, lower=0.0)
    frequency_Hz: Float[Array, ""] = param(unit="Hz", scale=10.0, lower=1e-3)
    quality: Float[Array, ""] = param(unit="1", scale=10.0, lower=0.5)

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
        """Variance that the vibration adds, shape `(t,)`."""
        return jnp.broadcast_to(self.amplitude_um**2, signal.values.shape)
