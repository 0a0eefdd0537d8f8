"""Accommodation: minor loops that are not congruent, as of a moving Preisach model, or narrow for some cycles."""

from typing import Any, ClassVar, Self

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from microid._linear import Times
from microid._param import param
from microid._part import AbstractPart, Signal
from microid.effects._base import AbstractEffect, Place, Scales, register
from microid.effects._irreversible import _anhysteretic

_PASSES = 2


@register
class Accommodation(AbstractEffect):
    r"""A field in proportion to the irreversible displacement, fed back into the hysteresis.

    .. math:: w = P[u + \alpha (w - w_{an}(u))]

    What of the feedback follows the voltage alone would be one more reversible part of the hysteresis, so it is left
    out: `w_an` is the mean of the two branches of the loop over the record's range. Two passes of a fixed point leave
    a relative error of `(alpha dw/du)^2` of the effect.

    Attributes
    ----------
    inner
        The hysteresis `P`.
    feedback_V_per_um
        `alpha`.
    """

    name: ClassVar[str] = "accommodation"
    takes: ClassVar[str] = "V"
    gives: ClassVar[str] = "um"
    place: ClassVar[Place] = "hysteresis"
    strength: ClassVar[tuple[str, ...]] = ("feedback_V_per_um",)
    fingerprint: ClassVar[str] = (
        "Minor loops between the same voltages differ in shape and height when they are reached from above and from "
        "below, and move for some cycles."
    )
    confusions: ClassVar[tuple[str, ...]] = (
        "creep",
        "aging",
        "curved_hysteresis",
        "sensor_nonlinearity",
        "initial_state",
    )
    experiment: ClassVar[str] = "The same minor loop reached from above and from below, ten times each."
    source: ClassVar[str] = (
        "moving Preisach model; Materials 16 (2023) 2422 on congruency; feedback times gain of 0.5 to 5 % (estimate)"
    )
    inner: AbstractPart
    feedback_V_per_um: Float[Array, ""] = param(unit="V/um", scale=0.05)

    @classmethod
    def probes(cls, scales: Scales, inner: AbstractPart | None) -> tuple[tuple[Self, ...], ...]:
        """A feedback of one percent of the voltage per stroke."""
        if inner is None:
            return ()
        return ((cls(inner, jnp.asarray(0.01 * (scales.upper_V - scales.lower_V) / scales.stroke_um)),),)

    def run(self, time_s: Times, signal: Signal, start: Any = None) -> Signal:
        """Pass on the voltage and what is fed back."""
        straight = _anhysteretic(self.inner, signal, start)

        # A loop that JAX sees, so that the hysteresis is compiled once; its first pass has nothing to feed back.
        def improve(found: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], None]:
            more = self.feedback_V_per_um * (found[0] - straight.values)
            before = self.feedback_V_per_um * (found[1] - straight.before)
            given = self.inner.run(time_s, signal.with_values(signal.values + more, signal.before + before), start)
            return (given.values, given.before), None

        (values, before), _ = lax.scan(improve, (straight.values, straight.before), None, length=_PASSES + 1)
        return signal.with_values(values, before)


@register
class NarrowingLoops(AbstractEffect):
    r"""Loops that narrow, or widen, in the first cycles, until they are closed.

    .. math:: w = P + a e^{-s / s_0} (P - P_{an}(u)), \qquad s = \int |du|

    Attributes
    ----------
    inner
        The hysteresis `P`, as it comes to be.
    wider
        `a`: by which part loops are wider at first.
    cycle_V
        `s0`, the path of the command on which they approach that.
    """

    name: ClassVar[str] = "accommodation"
    form: ClassVar[str] = "narrowing"
    takes: ClassVar[str] = "V"
    gives: ClassVar[str] = "um"
    place: ClassVar[Place] = "hysteresis"
    strength: ClassVar[tuple[str, ...]] = ("wider",)
    fingerprint: ClassVar[str] = Accommodation.fingerprint
    confusions: ClassVar[tuple[str, ...]] = Accommodation.confusions
    experiment: ClassVar[str] = Accommodation.experiment
    source: ClassVar[str] = "accommodation of first cycles; a tenth of a loop within some cycles (estimate)"
    inner: AbstractPart
    wider: Float[Array, ""] = param(unit="1", scale=0.1)
    cycle_V: Float[Array, ""] = param(unit="V", scale=100.0, lower=1e-3)

    @classmethod
    def probes(cls, scales: Scales, inner: AbstractPart | None) -> tuple[tuple[Self, ...], ...]:
        """Paths of half a cycle, two and eight."""
        if inner is None:
            return ()
        cycle = 2 * (scales.upper_V - scales.lower_V)
        return tuple((cls(inner, jnp.asarray(0.1), jnp.asarray(share * cycle)),) for share in (0.5, 2.0, 8.0))

    def run(self, time_s: Times, signal: Signal, start: Any = None) -> Signal:
        """Add what loops are wider by."""
        given, straight = self.inner.run(time_s, signal, start), _anhysteretic(self.inner, signal, start)
        path = jnp.cumsum(jnp.abs(jnp.diff(signal.values, prepend=signal.before)))
        more = self.wider * jnp.exp(-path / self.cycle_V)
        values = given.values + more * (given.values - straight.values)
        before = self.wider * (given.before - straight.before)
        return given.with_values(values, given.before + before)
