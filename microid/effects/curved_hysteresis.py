"""Curved hysteresis: a curve behind the loops, as in the modified operator of Prandtl and Ishlinskii."""

from typing import Any, ClassVar, Self

import jax.numpy as jnp
from jaxtyping import Array, Float

from microid._linear import Times
from microid._param import array, param
from microid._part import AbstractPart, Signal
from microid.effects._base import AbstractEffect, Place, Scales, register
from microid.effects._irreversible import _anhysteretic
from microid.effects._legendre import _legendre

# What of each degree is tried first.
_SOME = 0.01


@register
class CurvedHysteresis(AbstractEffect):
    r"""A curve behind the hysteresis, as in the modified operator of Prandtl and Ishlinskii.

    .. math:: w + \varphi(w) - \varphi(w_{an}(u)), \qquad
        \varphi(w) = Y \sum_n c_n P_n\left(\frac{w - c}{Y}\right)

    The `P` are Legendre's polynomials. What the curve makes of the voltage alone is left out: it would be one more
    reversible part of the hysteresis. `w_an` is the mean of the two branches of the largest loop.

    Attributes
    ----------
    inner
        The hysteresis `w`.
    curve_second, curve_third, curve_fourth, curve_fifth
        `c_2` to `c_5`: what the curve adds at the end of the stroke, over half the stroke.
    centre_um, half_stroke_um
        `c` and `Y`, given.
    """

    name: ClassVar[str] = "curved_hysteresis"
    takes: ClassVar[str] = "V"
    gives: ClassVar[str] = "um"
    place: ClassVar[Place] = "hysteresis"
    strength: ClassVar[tuple[str, ...]] = ("curve_second", "curve_third", "curve_fourth", "curve_fifth")
    fingerprint: ClassVar[str] = (
        "Minor loops between the same voltages close, and differ in height with the displacement that they are at."
    )
    confusions: ClassVar[tuple[str, ...]] = ("accommodation", "sensor_nonlinearity", "aging", "thermal_gain")
    experiment: ClassVar[str] = "The same minor loop reached from above and from below, at three biases."
    source: ClassVar[str] = "modified Prandtl-Ishlinskii operator: Kuhnen, European Journal of Control 9 (2003) 407"
    inner: AbstractPart
    curve_second: Float[Array, ""] = param(unit="1", scale=0.01)
    curve_third: Float[Array, ""] = param(unit="1", scale=0.01)
    curve_fourth: Float[Array, ""] = param(unit="1", scale=0.01)
    curve_fifth: Float[Array, ""] = param(unit="1", scale=0.01)
    centre_um: Float[Array, ""] = array()
    half_stroke_um: Float[Array, ""] = array()

    @classmethod
    def probes(cls, scales: Scales, inner: AbstractPart | None) -> tuple[tuple[Self, ...], ...]:
        """One group: each polynomial, about the middle of the stroke."""
        if inner is None:
            return ()
        middle, half = jnp.asarray(scales.middle_um), jnp.asarray(scales.stroke_um / 2)
        each = _SOME * jnp.eye(len(cls.strength))
        return (tuple(cls(inner, a, b, c, d, middle, half) for a, b, c, d in each),)

    def run(self, time_s: Times, signal: Signal, start: Any = None) -> Signal:
        """Bend what the hysteresis gives."""
        given, straight = self.inner.run(time_s, signal, start), _anhysteretic(self.inner, signal, start)
        values = given.values + self._curve(given.values) - self._curve(straight.values)
        return given.with_values(values, given.before + self._curve(given.before) - self._curve(straight.before))

    def _curve(self, displacement_um: Float[Array, "..."]) -> Float[Array, "..."]:
        place = (displacement_um - self.centre_um) / self.half_stroke_um
        parts = self.curve_second, self.curve_third, self.curve_fourth, self.curve_fifth
        return self.half_stroke_um * _legendre(place, parts, 2)
