"""Sensor nonlinearity: the reading is a curved function of the displacement."""

from typing import Any, ClassVar, Self

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from microid._in_numpy import _NumpySignal
from microid._linear import Times
from microid._param import array, param
from microid._part import AbstractPart, Signal
from microid.effects._base import AbstractEffect, Place, Scales, View, register


@register
class SensorNonlinearity(AbstractEffect):
    r"""A parabola and a cubic beside the line.

    .. math:: y + q_2 (y - c)^2 / Y + q_3 (y - c)^3 / Y^2

    Attributes
    ----------
    quadratic, cubic
        `q2` and `q3`: deviation at half the stroke from the centre, over half the stroke.
    centre_um, half_stroke_um
        `c` and `Y`, given.
    """

    name: ClassVar[str] = "sensor_nonlinearity"
    takes: ClassVar[str] = "um"
    gives: ClassVar[str] = "um"
    place: ClassVar[Place] = "sensor"
    strength: ClassVar[tuple[str, ...]] = ("quadratic", "cubic")
    fingerprint: ClassVar[str] = (
        "The residual is a function of the position alone, the same upwards and downwards and at all rates, and "
        "small oscillations are scaled by its slope."
    )
    confusions: ClassVar[tuple[str, ...]] = (
        "stiffness_hardening",
        "accommodation",
        "curved_hysteresis",
        "driver_saturation",
    )
    experiment: ClassVar[str] = (
        "Small chirps or minor loops at four biases, each reached from above and below, or a reference sensor."
    )
    source: ClassVar[str] = "polynomial calibration curve; 0.01 to 0.2 % of the sensor's range (estimate)"
    view: ClassVar[View] = "position"
    quadratic: Float[Array, ""] = param(unit="1", scale=1e-3)
    cubic: Float[Array, ""] = param(unit="1", scale=1e-3)
    centre_um: Float[Array, ""] = array()
    half_stroke_um: Float[Array, ""] = array()

    @classmethod
    def probes(cls, scales: Scales, inner: AbstractPart | None) -> tuple[tuple[Self, ...], ...]:
        """One group: a parabola and a cubic, about the middle of the stroke."""
        half, middle = jnp.asarray(scales.stroke_um / 2), jnp.asarray(scales.middle_um)
        none, some = jnp.asarray(0.0), jnp.asarray(1e-3)
        return ((cls(some, none, middle, half), cls(none, some, middle, half)),)

    def run(self, time_s: Times, signal: Signal, start: Any = None) -> Signal:
        """Bend the reading."""
        return signal.with_values(_bent(self, signal.values), _bent(self, signal.before))

    def in_numpy(self, interval_s: np.ndarray, signal: _NumpySignal) -> _NumpySignal:
        """Bend the reading."""
        return signal._replace(values=_bent(self, signal.values), before=_bent(self, signal.before))


def _bent(effect: Any, reading: Any) -> Any:
    place = (reading - effect.centre_um) / effect.half_stroke_um
    return reading + effect.half_stroke_um * place**2 * (effect.quadratic + effect.cubic * place)
