"""Load change: another mass on the stage."""

from typing import Any, ClassVar, Self

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from microid._linear import Times
from microid._param import param
from microid._part import AbstractPart, Signal, innermost
from microid._plant import Mechanics
from microid.effects._base import AbstractEffect, Place, Scales, View, _rate_of, _times_of, register


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
    view: ClassVar[View] = "frequency"
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

    At the instant displacement and velocity are those of the mass before, and go on from there.

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
    view: ClassVar[View] = "frequency"
    inner: AbstractPart
    mass_ratio: Float[Array, ""] = param(unit="1", scale=0.1, lower=-0.9)
    after_s: Float[Array, ""] = param(unit="s", lower=0.0)

    @classmethod
    def probes(cls, scales: Scales, inner: AbstractPart | None) -> tuple[tuple[Self, ...], ...]:
        """One percent more, from many instants of the shortest record on, as it may ring for a short while only."""
        if scales.resonance_Hz is None or inner is None:
            return ()
        instants = scales.shortest_s * np.arange(1, 20) / 20
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
        since = jnp.maximum(time - after_s, 0.0)
        more = jnp.where(time >= after_s, more - _decay(loaded, since, *_at(after_s, time, more)), 0.0)
    other = inner.run(time_s, signal, start)
    return other.with_values(other.values + more, other.before)


def _at(
    instant_s: Float[Array, ""], time_s: Float[Array, " t"], values: Float[Array, " t"]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Value and rate of change at an instant."""
    return jnp.interp(instant_s, time_s, values), jnp.interp(instant_s, time_s, _rate_of(time_s, values))


def _decay(
    mechanics: Mechanics, since_s: Float[Array, " t"], place_um: Float[Array, ""], speed_um_per_s: Float[Array, ""]
) -> Float[Array, " t"]:
    """How a stage rings down from a place and a speed."""
    omega, zeta = 2 * jnp.pi * mechanics.natural_frequency_Hz, mechanics.damping_ratio
    swing = omega * jnp.sqrt(jnp.maximum(1 - zeta**2, 1e-6))
    quarter = (speed_um_per_s + zeta * omega * place_um) / swing
    return jnp.exp(-zeta * omega * since_s) * (
        place_um * jnp.cos(swing * since_s) + quarter * jnp.sin(swing * since_s)
    )
