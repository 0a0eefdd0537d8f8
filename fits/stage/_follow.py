"""Changes of what comes out of a hysteresis, passed on through parts that are not linear."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fits.loop._run import Run
from fits.stage._run import joined
from microid import Coordinates, Signal, Stage

# Directions that are passed on at a time.
_AT_ONCE = 64


def passes_linearly(stage: Stage, place: int) -> bool:
    """Whether all that follows a part is linear."""
    after = stage.parts[place + 1 :]
    return not after or joined(after) is not None


def propagated(
    coordinates: Coordinates[Stage],
    place: int | None,
    z: Float[Array, " p"],
    run: Run,
    around_um: np.ndarray,
    moved_um: np.ndarray,
) -> np.ndarray:
    """Pass changes of what comes out of the hysteresis, shape `(n, k)`, on through what follows it, to first order.

    They are `around_um`, shape `(n,)`. Where all that follows is linear, they have been passed on already.
    """
    assert place is not None
    if passes_linearly(coordinates(z), place):
        return moved_um
    n, samples = len(run.record), run.samples
    pad = len(samples.weight) - n
    time_s = samples.time_s * samples.stride if samples.time_s.ndim == 0 else samples.time_s[:: samples.stride]
    signal = jnp.asarray(np.pad(around_um, (0, pad), mode="edge"))
    out = np.empty_like(moved_um)
    for first in range(0, moved_um.shape[1], _AT_ONCE):
        part = moved_um[:, first : first + _AT_ONCE].T
        full = np.pad(part, ((0, _AT_ONCE - len(part)), (0, pad)))
        answer = _propagated(coordinates, place, z, time_s, signal, jnp.asarray(full))
        out[:, first : first + _AT_ONCE] = np.asarray(answer)[: len(part), :n].T
    return out


@eqx.filter_jit
def _propagated(
    coordinates: Coordinates[Stage],
    place: int,
    z: Float[Array, " p"],
    time_s: Float[Array, " n"] | Float[Array, ""],
    around_um: Float[Array, " n"],
    moved_um: Float[Array, "k n"],
) -> Float[Array, "k n"]:
    stage = coordinates(z)

    def follow(values: Float[Array, " n"]) -> Float[Array, " n"]:
        signal = Signal(values, values[0], "first")
        for part in stage.parts[place + 1 :]:
            signal = part.run(time_s, signal)
        return signal.values

    _, push = jax.linearize(follow, around_um)
    return jax.vmap(push)(moved_um)
