"""Friction in guides, cables and seals, on the moving mass; or a spring that yields."""

from collections.abc import Callable
from typing import Any, ClassVar, Self

import jax.numpy as jnp
from jaxtyping import Array, Float

from microid._linear import Times
from microid._param import param
from microid._part import AbstractPart, Signal, innermost
from microid.effects._base import AbstractEffect, Place, Scales, register
from microid.effects._grids import _decades
from microid.effects._oscillator import _braked, _forces_um

_SMALL = 1e-6


@register
class Friction(AbstractEffect):
    r"""Dahl's friction of exponent one, against the motion of the mass.

    .. math::
        \ddot x + 2 \zeta \omega \dot x + \omega^2 (x + f z) = \omega^2 \lambda w, \qquad
        \frac{dz}{dx} = \frac{1 - z \, \mathrm{sgn} \, \dot x}{l}

    Before the first sample there is no friction, `z = 0`.

    Attributes
    ----------
    inner
        The mechanics.
    amplitude_um
        `f`: largest friction over the stiffness, half the width of the loop that it adds.
    length_um
        `l`, the way on which it builds up after a reversal.
    """

    name: ClassVar[str] = "friction"
    takes: ClassVar[str] = "um"
    gives: ClassVar[str] = "um"
    place: ClassVar[Place] = "mechanics"
    strength: ClassVar[tuple[str, ...]] = ("amplitude_um",)
    fast: ClassVar[bool] = True
    fingerprint: ClassVar[str] = (
        "Hysteresis inside the mechanics: more of it at each reversal, with a length of its own, and small free "
        "oscillations that die faster than large ones."
    )
    confusions: ClassVar[tuple[str, ...]] = ("backlash", "rate_dependence", "load_change")
    experiment: ClassVar[str] = "Free decay after small steps, and reversals at ten times the rate."
    source: ClassVar[str] = "Dahl 1968; cables 10 to 100 nm, rolling guides 0.1 to 5 um (estimate)"
    inner: AbstractPart
    amplitude_um: Float[Array, ""] = param(unit="um", scale=0.05, lower=0.0)
    length_um: Float[Array, ""] = param(unit="um", lower=1e-4, upper=1e3)

    @classmethod
    def probes(cls, scales: Scales, inner: AbstractPart | None) -> tuple[tuple[Self, ...], ...]:
        """Lengths in steps of half a decade, from a thousandth of the stroke to a tenth."""
        if scales.resonance_Hz is None or inner is None:
            return ()
        size = jnp.asarray(0.001 * scales.stroke_um)
        grid = _decades(max(0.001 * scales.stroke_um, 1e-3), 0.1 * scales.stroke_um, 2)
        return tuple((cls(inner, size, jnp.asarray(length)),) for length in grid)

    def run(self, time_s: Times, signal: Signal, start: Any = None) -> Signal:
        """Let the mechanics answer to what the friction leaves of the piezo's displacement."""
        mechanics = innermost(self.inner)

        def law(before: Array, there: Array, state: Array) -> tuple[Array, Array]:
            way = (there - before) / self.length_um
            long = jnp.maximum(jnp.abs(way), _SMALL)
            # Written so that it has the right derivative where nothing moves.
            state = state * jnp.exp(-jnp.abs(way)) - way * jnp.expm1(-long) / long
            return self.amplitude_um * state / mechanics.gain, state

        none = jnp.zeros_like(signal.before)
        taken = _forces_um(mechanics, time_s, signal, law, none, none)
        return _braked(self.inner, time_s, signal, start, taken, none)


def _over(function: Callable[[Array], Array], x: Array, bend: float) -> Array:
    """A function over its argument, where it is `x + bend x^2` near zero."""
    small = jnp.abs(x) < _SMALL
    safe = jnp.where(small, 1.0, x)
    return jnp.where(small, 1 + bend * x, function(safe) / safe)


@register
class BoucWenForce(AbstractEffect):
    r"""A force of Bouc and Wen on the mass: hysteresis inside the mechanics, of which Dahl's friction is one case.

    .. math::
        \ddot x + 2 \zeta \omega \dot x + \omega^2 (x + f z) = \omega^2 \lambda w, \qquad
        \frac{dz}{dx} = \frac{1 - |z| \left(\gamma + \mathrm{sgn}(z \dot x)\right)}{l}

    Before the first sample there is no force, `z = 0`. Between two samples it is exact where `x` does not turn.

    Attributes
    ----------
    inner
        The mechanics.
    amplitude_um
        `f`: the force over the stiffness approaches `f / (1 + gamma)`.
    length_um
        `l`, the way on which it builds up after a reversal.
    gamma
        Zero for Dahl's friction, positive where the force bends more on its way up than on its way down after a
        reversal (`gamma / beta` in Bouc and Wen's letters; 1 and less where it obeys thermodynamics).
    """

    name: ClassVar[str] = "friction"
    form: ClassVar[str] = "bouc_wen"
    takes: ClassVar[str] = "um"
    gives: ClassVar[str] = "um"
    place: ClassVar[Place] = "mechanics"
    strength: ClassVar[tuple[str, ...]] = ("amplitude_um",)
    fast: ClassVar[bool] = True
    fingerprint: ClassVar[str] = Friction.fingerprint
    confusions: ClassVar[tuple[str, ...]] = Friction.confusions
    experiment: ClassVar[str] = Friction.experiment
    source: ClassVar[str] = "Bouc 1967, Wen 1976; Noel and Schoukens 2016"
    inner: AbstractPart
    amplitude_um: Float[Array, ""] = param(unit="um", scale=0.05, lower=0.0)
    length_um: Float[Array, ""] = param(unit="um", lower=1e-4, upper=1e3)
    gamma: Float[Array, ""] = param(unit="1", lower=-0.95, upper=1.5)

    @classmethod
    def probes(cls, scales: Scales, inner: AbstractPart | None) -> tuple[tuple[Self, ...], ...]:
        """The same as of Dahl's friction."""
        none = jnp.zeros(())
        return tuple(
            tuple(cls(p.inner, p.amplitude_um, p.length_um, none) for p in group)
            for group in Friction.probes(scales, inner)
        )

    def run(self, time_s: Times, signal: Signal, start: Any = None) -> Signal:
        """Let the mechanics answer to what the force leaves of the piezo's displacement."""
        mechanics = innermost(self.inner)

        def law(before: Array, there: Array, state: Array) -> tuple[Array, Array]:
            way = (there - before) / self.length_um
            size = jnp.abs(way)
            # Counted along the motion, a state against it falls to zero first, and then it builds up.
            along = jnp.where(way < 0, -state, state)
            fall, rise = 1 - self.gamma, 1 + self.gamma
            against, begun = jnp.minimum(along, 0), jnp.maximum(along, 0)
            taken = -against * _over(jnp.log1p, -fall * against, -0.5)
            falling = against * jnp.exp(-fall * size) + size * _over(jnp.expm1, -fall * size, 0.5)
            left = jnp.maximum(size - taken, 0)
            rising = begun * jnp.exp(-rise * left) + left * _over(jnp.expm1, -rise * left, 0.5)
            moved = jnp.where(size < taken, falling, rising)
            # Where nothing moves, the mean of both directions' derivatives.
            state = jnp.where(size > 0, jnp.where(way < 0, -moved, moved), state + way)
            return self.amplitude_um * state / mechanics.gain, state

        none = jnp.zeros_like(signal.before)
        taken_um = _forces_um(mechanics, time_s, signal, law, none, none)
        return _braked(self.inner, time_s, signal, start, taken_um, none)
