"""Reading a sampled signal between its samples."""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from microid._linear import Times
from microid._part import Signal
from microid.effects._base import _times_of

_NODES = 4


def _read_at(time_s: Times, signal: Signal, when_s: Float[Array, " t"]) -> Float[Array, " t"]:
    """Read a signal at other times, by cubics through the four samples around each (Lagrange), shape `(t,)`.

    Parameters
    ----------
    time_s
        Increasing times of the samples, shape `(t,)`, or their one interval, shape `()`.
    signal
        What is read. Before its first sample it is `signal.before`, behind the last it stays what it is.
    when_s
        Times to read at, counted from the first sample, shape `(t,)`. Derivatives flow into them.
    """
    count = signal.values.shape[0]
    time = _times_of(time_s, count)
    if count < _NODES:
        return jnp.interp(when_s, time, signal.values, left=signal.before)
    fixed = lax.stop_gradient(when_s)
    if time_s.ndim == 0:
        place = jnp.floor(fixed / time_s).astype(jnp.int32)
    else:
        place = jnp.searchsorted(time, fixed, side="right").astype(jnp.int32) - 1
    interval = time[1] - time[0]
    nodes = jnp.concatenate([-interval * jnp.asarray([2.0, 1.0], dtype=time.dtype), time])
    values = jnp.concatenate([jnp.stack([signal.before, signal.before]), signal.values])
    first = jnp.clip(place + 1, 0, count + 2 - _NODES)
    at, read = [nodes[first + j] for j in range(_NODES)], [values[first + j] for j in range(_NODES)]
    when = jnp.clip(when_s, -interval, time[-1])
    total = jnp.zeros_like(when)
    for j in range(_NODES):
        weight = jnp.ones_like(when)
        for other in range(_NODES):
            weight = weight if other == j else weight * (when - at[other]) / (at[j] - at[other])
        total = total + weight * read[j]
    return total
