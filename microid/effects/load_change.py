"""Load change: another mass on the stage."""

from typing import Any, ClassVar, Self

import jax.numpy as jnp
from jaxtyping import Array, Float

from microid._linear import Times
from microid._param import param
from microid._part import AbstractPart, Signal
from microid._plant import Mechanics
from microid.effects._base import AbstractEffect, Place, Scales, _innermost, register


@register
class LoadChange(AbstractEffect):
    r"""Mechanics with another mass, and the same stiffness and damper.

    .. math:: \omega \leftarrow \omega / \sqrt{1 + \mu}, \qquad \zeta \leftarrow \zeta / \sqrt{1 + \mu}

    Around other effects of the mechanics it adds what it changes in the plain mechanics.

    Attributes
    ----------
    inner
        The mechanics.
    mass_ratio
        `mu`: change of the moving mass over the mass.
    """

    name: ClassVar[str] = "load_change"
    takes: ClassVar[str] = "um"
    gives: ClassVar[str] = "um"
    place: ClassVar[Place] = "mechanics"
    strength: ClassVar[tuple[str, ...]] = ("mass_ratio",)
    fast: ClassVar[bool] = True
    per_run: ClassVar[bool] = True
    fingerprint: ClassVar[str] = "Records ring at different frequencies, and are alike at rest."
    confusions: ClassVar[tuple[str, ...]] = ("stiffness_hardening", "second_resonance", "friction")
    experiment: ClassVar[str] = "A short small chirp at the start and the end of every record."
    source: ClassVar[str] = "natural frequency sqrt(k / m); payloads of 1 to 200 % of the moving mass (estimate)"
    inner: AbstractPart
    mass_ratio: Float[Array, ""] = param(unit="1", scale=0.1, lower=-0.9)

    @classmethod
    def probes(cls, scales: Scales, inner: AbstractPart | None) -> tuple[tuple[Self, ...], ...]:
        """One percent more."""
        return () if scales.resonance_Hz is None or inner is None else ((cls(inner, jnp.asarray(0.01)),),)

    def run(self, time_s: Times, signal: Signal, start: Any = None) -> Signal:
        """Let the mechanics answer with the other mass."""
        plain = _innermost(self.inner)
        slower = 1 / jnp.sqrt(1 + self.mass_ratio)
        loaded = Mechanics(plain.natural_frequency_Hz * slower, plain.damping_ratio * slower, plain.gain)
        given = loaded.run(time_s, signal, start)
        if isinstance(self.inner, Mechanics):
            return given
        more = given.values - plain.run(time_s, signal, start).values
        other = self.inner.run(time_s, signal, start)
        return Signal(other.values + more, other.before, other.hold)
