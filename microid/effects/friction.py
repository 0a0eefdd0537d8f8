"""Friction in guides, cables and seals, on the moving mass."""

from typing import Any, ClassVar, Self

import jax.numpy as jnp
from jaxtyping import Array, Float

from microid._linear import Times
from microid._param import param
from microid._part import AbstractPart, Signal, innermost
from microid.effects._base import AbstractEffect, Place, Scales, register
from microid.effects._grids import _decades
from microid.effects._oscillator import _forces_um

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
        "More hysteresis at each reversal with a length of its own, and small free oscillations that die faster than "
        "large ones."
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
        return self.inner.run(time_s, Signal(signal.values - taken, signal.before, signal.hold), start)
