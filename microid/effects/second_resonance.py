"""A second resonance: a mode of the mechanism, or of what stands on it, beyond the first."""

from typing import Any, ClassVar, Self

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from microid._linear import Times
from microid._param import param
from microid._part import AbstractPart, Signal, innermost
from microid._plant import Mechanics
from microid.effects._base import AbstractEffect, Place, Scales, View, register


@register
class SecondResonance(AbstractEffect):
    r"""A second mode that takes over a share of the displacement.

    .. math:: y = (1 - g) G w + g \lambda H_2 w

    with `H_2 = omega_2^2 / (s^2 + 2 zeta_2 omega_2 s + omega_2^2)`.

    Attributes
    ----------
    inner
        The mechanics `G`, of static gain `lambda`.
    share
        `g`: positive where both modes move the sensor alike, negative where an anti-resonance lies between them.
    frequency_Hz
        `omega_2 / 2 pi`.
    damping_ratio
        `zeta_2`; from `1 / sqrt(2)` on there is no peak, and no resonance.
    """

    name: ClassVar[str] = "second_resonance"
    takes: ClassVar[str] = "um"
    gives: ClassVar[str] = "um"
    place: ClassVar[Place] = "mechanics"
    strength: ClassVar[tuple[str, ...]] = ("share",)
    fast: ClassVar[bool] = True
    extremes: ClassVar[tuple[str, ...]] = ("damping_ratio",)
    fingerprint: ClassVar[str] = (
        "Ringing at a second frequency after steps, and a narrow peak or notch in the frequency response; nothing in "
        "slow records."
    )
    confusions: ClassVar[tuple[str, ...]] = ("transport_delay", "sensor_lowpass", "stiffness_hardening")
    experiment: ClassVar[str] = "Chirps of two small amplitudes to three times the first resonance or more."
    source: ClassVar[str] = "modal superposition; shares of 0.01 to 0.3 at 0.2 to 6 times the main one (estimate)"
    view: ClassVar[View] = "frequency"
    inner: AbstractPart
    share: Float[Array, ""] = param(unit="1", scale=0.01)
    frequency_Hz: Float[Array, ""] = param(unit="Hz", scale=100.0, lower=1e-3)
    damping_ratio: Float[Array, ""] = param(unit="1", scale=0.01, lower=1e-5, upper=0.7)

    @classmethod
    def probes(cls, scales: Scales, inner: AbstractPart | None) -> tuple[tuple[Self, ...], ...]:
        """Frequencies from 0.2 to 6 times the first resonance, close enough for the peaks between them to be met."""
        if scales.resonance_Hz is None or inner is None:
            return ()
        # What is nearer to the first resonance is that.
        below, above = np.geomspace(0.2, 1 / 1.15, 18), np.geomspace(1.15, 6, 40)
        grid = scales.resonance_Hz * np.concatenate([below, above])
        grid = grid[grid < 0.45 / scales.interval_s]
        share, damping = jnp.asarray(0.01), jnp.asarray(0.03)
        return tuple((cls(inner, share, jnp.asarray(float(frequency)), damping),) for frequency in grid)

    def run(self, time_s: Times, signal: Signal, start: Any = None) -> Signal:
        """Add the second mode's answer."""
        first = self.inner.run(time_s, signal, start)
        mode = Mechanics(self.frequency_Hz, self.damping_ratio)
        more = innermost(self.inner).gain * mode.run(time_s, signal, start).values - first.values
        return first.with_values(first.values + self.share * more, first.before)


@register
class AddedResonance(AbstractEffect):
    r"""A second mode on top of the mechanics, less what it does at rest: all else is rigid behind it.

    .. math:: y = G w + g \lambda (H_2 - 1) w, \qquad H_2 = \frac{\omega_2^2}{s^2 + 2 \zeta_2 \omega_2 s + \omega_2^2}

    Attributes
    ----------
    inner
        The mechanics `G`, of static gain `lambda`.
    share
        `g`: positive where both modes move the sensor alike, negative where an anti-resonance lies between them.
    frequency_Hz
        `omega_2 / 2 pi`.
    damping_ratio
        `zeta_2`; from `1 / sqrt(2)` on there is no peak, and no resonance.
    """

    name: ClassVar[str] = "second_resonance"
    form: ClassVar[str] = "added"
    takes: ClassVar[str] = "um"
    gives: ClassVar[str] = "um"
    place: ClassVar[Place] = "mechanics"
    strength: ClassVar[tuple[str, ...]] = ("share",)
    fast: ClassVar[bool] = True
    extremes: ClassVar[tuple[str, ...]] = ("damping_ratio",)
    fingerprint: ClassVar[str] = SecondResonance.fingerprint
    confusions: ClassVar[tuple[str, ...]] = SecondResonance.confusions
    experiment: ClassVar[str] = SecondResonance.experiment
    source: ClassVar[str] = SecondResonance.source
    view: ClassVar[View] = "frequency"
    inner: AbstractPart
    share: Float[Array, ""] = param(unit="1", scale=0.01)
    frequency_Hz: Float[Array, ""] = param(unit="Hz", scale=100.0, lower=1e-3)
    damping_ratio: Float[Array, ""] = param(unit="1", scale=0.01, lower=1e-5, upper=0.7)

    @classmethod
    def probes(cls, scales: Scales, inner: AbstractPart | None) -> tuple[tuple[Self, ...], ...]:
        """The same as for a mode that takes over a share."""
        return tuple(
            tuple(cls(p.inner, p.share, p.frequency_Hz, p.damping_ratio) for p in group)
            for group in SecondResonance.probes(scales, inner)
        )

    def run(self, time_s: Times, signal: Signal, start: Any = None) -> Signal:
        """Add the second mode's answer."""
        first = self.inner.run(time_s, signal, start)
        mode = Mechanics(self.frequency_Hz, self.damping_ratio)
        more = innermost(self.inner).gain * (mode.run(time_s, signal, start).values - signal.values)
        return first.with_values(first.values + self.share * more, first.before)
