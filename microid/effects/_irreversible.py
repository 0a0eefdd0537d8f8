"""What of a hysteresis depends on the voltage alone, and what on its past."""

from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from microid._part import AbstractPart, Scene, Signal, innermost
from microid._preisach import Preisach

# Levels of the sweep, and its interval: so slow that no effect of the rate is left.
_LEVELS, _SLOW_S = 65, 1e4


def _anhysteretic(inner: AbstractPart, signal: Signal, start: Any) -> Signal:
    """Mean of the two branches of the largest loop, in um, at the voltages of the signal.

    That of a `Preisach` goes over the range of its density, the same in all runs, and that of another law over the
    range of the signal.
    """
    low = jnp.minimum(jnp.min(signal.values), signal.before)
    high = jnp.maximum(jnp.max(signal.values), signal.before)
    law = innermost(inner)
    if isinstance(law, Preisach):
        low, high = law.density.lower_V, law.density.upper_V
    step = (high - low) / (_LEVELS - 1)
    up = low + step * jnp.asarray(np.arange(_LEVELS), dtype=low.dtype)
    sweep = Signal(jnp.concatenate([up, up[::-1], up]), low, "first")
    slowly_s = jnp.asarray(_SLOW_S, dtype=low.dtype)
    branches = inner.run(slowly_s, sweep, _without_past(start)).values.reshape(3, _LEVELS)
    mean = (branches[1][::-1] + branches[2]) / 2

    def at(voltage_V: Float[Array, "..."]) -> Float[Array, "..."]:
        place = (voltage_V - low) / jnp.maximum(step, jnp.finfo(low.dtype).tiny)
        left = jnp.clip(jnp.floor(place), 0, _LEVELS - 2).astype(jnp.int32)
        share = place - left.astype(low.dtype)
        return mean[left] * (1 - share) + mean[left + 1] * share

    return signal.with_values(at(signal.values), at(signal.before))


def _without_past(start: Any) -> Any:
    """The same before the first sample; what an unknown past adds belongs to the signal of the scene alone."""
    return replace(start, past_um=None) if isinstance(start, Scene) else start
