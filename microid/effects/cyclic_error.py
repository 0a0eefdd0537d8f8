"""Cyclic error: what an interferometer or an encoder adds in every period of its scale."""

from typing import Any, ClassVar, Self

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from microid._in_numpy import _NumpySignal
from microid._linear import Times
from microid._param import array, param
from microid._part import AbstractPart, Signal
from microid.effects._base import AbstractEffect, Place, Scales, View, register

_HARMONICS = 2


@register
class CyclicError(AbstractEffect):
    r"""A wave over the position, and its second harmonic.

    .. math:: y + \sum_{h=1}^{2} A_h \cos \frac{2 \pi h (y - c)}{p} + B_h \sin \frac{2 \pi h (y - c)}{p}

    Attributes
    ----------
    cosine_um, sine_um
        `A` and `B`, shape `(2,)`.
    period_um
        `p`.
    centre_um
        `c`, given.
    """

    name: ClassVar[str] = "cyclic_error"
    takes: ClassVar[str] = "um"
    gives: ClassVar[str] = "um"
    place: ClassVar[Place] = "sensor"
    strength: ClassVar[tuple[str, ...]] = ("cosine_um", "sine_um")
    phases: ClassVar[tuple[str, ...]] = ("cosine_um", "sine_um")
    fingerprint: ClassVar[str] = (
        "The residual repeats itself in every period of the position, at any rate and both ways."
    )
    confusions: ClassVar[tuple[str, ...]] = ("floor_vibration", "timestamp_jitter")
    experiment: ClassVar[str] = "A slow ramp over some periods, up and down, from two offsets of the sensor."
    source: ClassVar[str] = (
        "periodic deviation of interferometers: parts of a nanometre to some nanometres, at fractions of the "
        "wavelength; of encoders, at their grating period (estimate)"
    )
    view: ClassVar[View] = "position"
    origin: ClassVar[tuple[str, ...]] = ("centre_um", "period_um")
    cosine_um: Float[Array, " 2"] = param(unit="um", scale=0.01)
    sine_um: Float[Array, " 2"] = param(unit="um", scale=0.01)
    period_um: Float[Array, ""] = param(unit="um", scale=1.0, lower=0.0)
    centre_um: Float[Array, ""] = array()

    @classmethod
    def probes(cls, scales: Scales, inner: AbstractPart | None) -> tuple[tuple[Self, ...], ...]:
        """Cosines and sines of both waves, of the period with which the residual repeats itself; none without one."""
        if scales.period_um is None:
            return ()
        none, centre = jnp.zeros(_HARMONICS), jnp.asarray(scales.middle_um)
        period = jnp.asarray(scales.period_um)
        lines = [none.at[h].set(0.01) for h in range(_HARMONICS)]
        pairs = [pair for line in lines for pair in ((line, none), (none, line))]
        return (tuple(cls(cosine, sine, period, centre) for cosine, sine in pairs),)

    def run(self, time_s: Times, signal: Signal, start: Any = None) -> Signal:
        """Add the waves."""
        return signal.with_values(_waves(self, signal.values, jnp), _waves(self, signal.before, jnp))

    def in_numpy(self, interval_s: np.ndarray, signal: _NumpySignal) -> _NumpySignal:
        """Add the waves."""
        return signal._replace(values=_waves(self, signal.values, np), before=_waves(self, signal.before, np))


def _waves(effect: Any, position: Any, of: Any) -> Any:
    turn = 2 * np.pi * (position - effect.centre_um) / effect.period_um
    for k in range(_HARMONICS):
        phase = (k + 1) * turn
        position = position + effect.cosine_um[k] * of.cos(phase) + effect.sine_um[k] * of.sin(phase)
    return position
