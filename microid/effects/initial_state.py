"""Initial state: the hysteresis remembers a voltage from before the record."""

from dataclasses import replace
from typing import Any, ClassVar, Self

import jax.numpy as jnp
from jaxtyping import Array, Float

from microid._linear import Times
from microid._param import param
from microid._part import AbstractPart, Scene, Signal
from microid.effects._base import AbstractEffect, Place, Scales, View, register


@register
class InitialState(AbstractEffect):
    r"""A stage that went up by `e` above its first voltage and came back, before the record.

    Before that it had the memory that it is given: by default, for `Preisach`, that of negative saturation.

    Attributes
    ----------
    inner
        The hysteresis.
    excess_V
        `e`, of the voltage behind the driver.
    """

    name: ClassVar[str] = "initial_state"
    takes: ClassVar[str] = "V"
    gives: ClassVar[str] = "um"
    place: ClassVar[Place] = "hysteresis"
    strength: ClassVar[tuple[str, ...]] = ("excess_V",)
    finite: ClassVar[bool] = True
    per_run: ClassVar[bool] = True
    past: ClassVar[bool] = True
    fingerprint: ClassVar[str] = (
        "The residual lasts until the voltage first exceeds all before, and is gone from there on."
    )
    confusions: ClassVar[tuple[str, ...]] = ("creep", "aging", "accommodation")
    experiment: ClassVar[str] = "A sweep over the whole range before every record."
    source: ClassVar[str] = "wiping-out property of the Preisach operator: Mayergoyz 1991"
    view: ClassVar[View] = "time"
    inner: AbstractPart
    excess_V: Float[Array, ""] = param(unit="V", scale=10.0, lower=0.0)

    @classmethod
    def probes(cls, scales: Scales, inner: AbstractPart | None) -> tuple[tuple[Self, ...], ...]:
        """A tenth, a quarter, a half and the whole of the range."""
        span = scales.upper_V - scales.lower_V
        shares = (0.1, 0.25, 0.5, 1.0)
        return () if inner is None else tuple((cls(inner, jnp.asarray(share * span)),) for share in shares)

    def run(self, time_s: Times, signal: Signal, start: Any = None) -> Signal:
        """Put the way from that voltage ahead of the record."""
        high = signal.before + self.excess_V
        longer = signal.with_values(jnp.concatenate([signal.before[None], signal.values]), high)
        time = time_s
        if time.ndim == 1:
            ahead = time[1] - time[0] if time.shape[0] > 1 else jnp.ones_like(time[0])
            time = jnp.concatenate([(time[0] - ahead)[None], time])
        if isinstance(start, Scene) and start.past_um is not None:
            start = replace(start, past_um=jnp.concatenate([start.past_um[:1], start.past_um]))
        given = self.inner.run(time, longer, start)
        return given.with_values(given.values[1:], given.values[0])
