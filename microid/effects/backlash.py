"""Backlash: clearance in a joint between the piezo and the mechanics, or behind these."""

from typing import Any, ClassVar, Self

import jax.numpy as jnp
from jaxtyping import Array, Float

from microid._linear import Times
from microid._param import param
from microid._part import AbstractPart, Signal
from microid.effects._base import AbstractEffect, Place, Scales, register
from microid.hysteresis._play import _plays


class _AbstractBacklash(AbstractEffect):
    """A play: an output that stays until one side of the clearance pushes it."""

    name: ClassVar[str] = "backlash"
    takes: ClassVar[str] = "um"
    gives: ClassVar[str] = "um"
    strength: ClassVar[tuple[str, ...]] = ("half_gap_um",)
    finite: ClassVar[bool] = True
    fingerprint: ClassVar[str] = (
        "The displacement stays for a while after every reversal, however small the loop, and small oscillations are "
        "lost."
    )
    confusions: ClassVar[tuple[str, ...]] = ("friction", "slew_limit", "quantisation")
    experiment: ClassVar[str] = "Fast downward steps of several heights, and chirps at a low and a high bias."
    source: ClassVar[str] = "play operator; Micromachines 16 (2025) 1024 on preload; 0.05 to 2 um (estimate)"
    half_gap_um: Float[Array, ""] = param(unit="um", scale=0.1, lower=0.0)
    start: Float[Array, ""] = param(unit="1", lower=-1.0, upper=1.0)

    @classmethod
    def probes(cls, scales: Scales, inner: AbstractPart | None) -> tuple[tuple[Self, ...], ...]:
        """A thousandth of the stroke, three and ten."""
        return tuple(
            (cls(jnp.asarray(share * scales.stroke_um), jnp.asarray(0.0)),) for share in (0.001, 0.003, 0.01)
        )

    def run(self, time_s: Times, signal: Signal, start: Any = None) -> Signal:
        """Drag the output along."""
        place = signal.before + self.start * self.half_gap_um
        return signal.with_values(_plays(signal.values, self.half_gap_um[None], place[None])[:, 0], place)


@register
class Backlash(_AbstractBacklash):
    r"""Clearance between the piezo and the mechanics, which a play drives.

    .. math:: y_k = \min(\max(y_{k-1}, w_k - b), w_k + b)

    Attributes
    ----------
    half_gap_um
        `b`.
    start
        Where in its clearance it stands before the first sample, from -1 to 1: at 1 where it came down to rest.
    """

    place: ClassVar[Place] = "mechanics"


@register
class OutputBacklash(_AbstractBacklash):
    r"""Clearance behind the mechanics, as of a guide, which the mass drags along.

    .. math:: y_k = \min(\max(y_{k-1}, x_k - b), x_k + b)

    Attributes
    ----------
    half_gap_um
        `b`.
    start
        Where in its clearance it stands before the first sample, from -1 to 1, as of `Backlash`.
    """

    form: ClassVar[str] = "output"
    place: ClassVar[Place] = "environment"
    fast: ClassVar[bool] = True
