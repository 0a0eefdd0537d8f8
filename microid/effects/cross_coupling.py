"""Cross-coupling: the other axis moves this one, or tilts it."""

from typing import Any, ClassVar, Self

import jax.numpy as jnp
from jaxtyping import Array, Float

from microid._linear import Times
from microid._param import param
from microid._part import AbstractPart, Signal
from microid.effects._base import AbstractEffect, Place, Scales, View, register


@register
class CrossCoupling(AbstractEffect):
    """A share of the other axis' displacement: `y + c x`.

    Attributes
    ----------
    gain
        `c`.
    """

    name: ClassVar[str] = "cross_coupling"
    takes: ClassVar[str] = "um"
    gives: ClassVar[str] = "um"
    place: ClassVar[Place] = "environment"
    strength: ClassVar[tuple[str, ...]] = ("gain",)
    needs: ClassVar[tuple[str, ...]] = ("other_um",)
    fingerprint: ClassVar[str] = "The residual follows the other axis, and is gone while that one rests."
    confusions: ClassVar[tuple[str, ...]] = ("thermal_drift", "creep", "floor_vibration")
    experiment: ClassVar[str] = "The other axis driven alone, with its position as a column other_um."
    source: ClassVar[str] = "doi 10.1177/16878140211014061: 0.98 % of full travel; doi 10.1177/1687814016638301: 1 %"
    view: ClassVar[View] = "time"
    column: ClassVar[str] = "other_um"
    gain: Float[Array, ""] = param(unit="1", scale=1e-3)

    @classmethod
    def probes(cls, scales: Scales, inner: AbstractPart | None) -> tuple[tuple[Self, ...], ...]:
        """One, of three times the noise."""
        spread = _spread_um(scales)
        return ((cls(jnp.asarray(3 * scales.noise_um / spread)),),) if spread > 0 else ()

    def run(self, time_s: Times, signal: Signal, start: Any = None) -> Signal:
        """Add the share."""
        more = self.gain * start.columns["other_um"]
        return signal.with_values(signal.values + more, signal.before + more[0])


@register
class QuadraticCrossCoupling(AbstractEffect):
    """Shortening of flexures that the other axis bends: `y + e x^2`.

    Attributes
    ----------
    curvature_per_um
        `e`; of the order of one over twice the length of the flexures.
    """

    name: ClassVar[str] = "cross_coupling"
    form: ClassVar[str] = "quadratic"
    takes: ClassVar[str] = "um"
    gives: ClassVar[str] = "um"
    place: ClassVar[Place] = "environment"
    strength: ClassVar[tuple[str, ...]] = ("curvature_per_um",)
    needs: ClassVar[tuple[str, ...]] = ("other_um",)
    fingerprint: ClassVar[str] = CrossCoupling.fingerprint
    confusions: ClassVar[tuple[str, ...]] = CrossCoupling.confusions
    experiment: ClassVar[str] = CrossCoupling.experiment
    source: ClassVar[str] = "kinematic shortening x^2 / 2 L of a guiding beam: 0.16 um for 40 um on 10 mm"
    view: ClassVar[View] = "time"
    column: ClassVar[str] = "other_um"
    curvature_per_um: Float[Array, ""] = param(unit="1/um", scale=1e-5)

    @classmethod
    def probes(cls, scales: Scales, inner: AbstractPart | None) -> tuple[tuple[Self, ...], ...]:
        """One, of three times the noise."""
        spread = _spread_um(scales)
        return ((cls(jnp.asarray(3 * scales.noise_um / spread**2)),),) if spread > 0 else ()

    def run(self, time_s: Times, signal: Signal, start: Any = None) -> Signal:
        """Add the shortening."""
        more = self.curvature_per_um * start.columns["other_um"] ** 2
        return signal.with_values(signal.values + more, signal.before + more[0])


def _spread_um(scales: Scales) -> float:
    return {name: spread for name, _, spread in scales.columns}.get("other_um", 0.0)
