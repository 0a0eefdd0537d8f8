"""Load change: another mass on the stage."""

from typing import Any, ClassVar, Self

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from microid._linear import Times
from microid._param import param
from microid._part import AbstractPart, Signal, innermost
from microid._plant import Mechanics
from microid.effects._base import AbstractEffect, Place, Scales, _times_of, register


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
        return _loaded(self.inner, self.mass_ratio, time_s, signal, start, None)


@register
class LoadChangeWithin(AbstractEffect):
    r"""Mechanics whose mass changes during a record.

    From the instant on the answer is that of the other mass, as if it had been there before: what rings on from one
    mass to the other is left out.

    Attributes
    ----------
    inner
        The mechanics.
    mass_ratio
        `mu`: change of the moving mass over the mass.
    after_s
        When, from the first sample on.
    """

    name: ClassVar[str] = "load_change"
    form: ClassVar[str] = "within"
    takes: ClassVar[str] = "um"
    gives: ClassVar[str] = "um"
    place: ClassVar[Place] = "mechanics"
    strength: ClassVar[tuple[str, ...]] = ("mass_ratio",)
    fast: ClassVar[bool] = True
    per_run: ClassVar[bool] = True
    fingerprint: ClassVar[str] = "From some instant on the stage rings at another frequency, and is alike at rest."
    confusions: ClassVar[tuple[str, ...]] = LoadChange.confusions
    experiment: ClassVar[str] = LoadChange.experiment
    source: ClassVar[str] = LoadChange.source
    inner: AbstractPart
    mass_ratio: Float[Array, ""] = param(unit="1", scale=0.1, lower=-0.9)
    after_s: Float[Array, ""] = param(unit="s", lower=0.0)

    @classmethod
    def probes(cls, scales: Scales, inner: AbstractPart | None) -> tuple[tuple[Self, ...], ...]:
        """One percent more, from nine instants of the shortest record on."""
        if scales.resonance_Hz is None or inner is None:
            return ()
        instants = scales.shortest_s * np.arange(1, 10) / 10
        return tuple((cls(inner, jnp.asarray(0.01), jnp.asarray(float(at))),) for at in instants)

    def run(self, time_s: Times, signal: Signal, start: Any = None) -> Signal:
        """Let the mechanics answer with the other mass from the instant on."""
        return _loaded(self.inner, self.mass_ratio, time_s, signal, start, self.after_s)


def _loaded(
    inner: AbstractPart,
    mass_ratio: Float[Array, ""],
    time_s: Times,
    signal: Signal,
    start: Any,
    after_s: Float[Array, ""] | None,
) -> Signal:
    plain = innermost(inner)
    slower = 1 / jnp.sqrt(1 + mass_ratio)
    loaded = Mechanics(plain.natural_frequency_Hz * slower, plain.damping_ratio * slower, plain.gain)
    more = loaded.run(time_s, signal, start).values - plain.run(time_s, signal, start).values
    if after_s is not None:
        time = _times_of(time_s, more.shape[0])
        # Over a period of the resonance, so that there is a derivative.
        more = more * jax.nn.sigmoid((time - after_s) * plain.natural_frequency_Hz * 4)
    other = inner.run(time_s, signal, start)
    return Signal(other.values + more, other.before, other.hold)
