"""The tangent of a stage with effects that level off, which is not that of the plain one."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fits.diagnosis._evaluate import with_effects
from fits.loop._run import Run
from fits.stage._moments import Chain
from fits.stage._run import joined, place_of_hysteresis
from microid import PLACES, AbstractEffect, Coordinates, Signal, Stage

# Directions that are passed on at a time.
_TOGETHER = 64
# Places of effects that are added to whatever the stage does.
_ALONE = ("environment", "noise")


class _Dressed(eqx.Module):
    """Coordinates of a plain stage, of which a stage with effects is made."""

    plain: Coordinates[Stage]
    effects: tuple[AbstractEffect, ...]

    def __call__(self, z: Float[Array, " p"]) -> Stage:
        """The stage with the effects."""
        return with_effects(self.plain(z), self.effects)


def passed(effects: Sequence[AbstractEffect]) -> tuple[AbstractEffect, ...]:
    """Those that the tangent has to go through: a rail, say, beyond which nothing moves any more.

    They level off, stand by themselves, and act before the mechanics has answered.
    """
    last = PLACES.index("mechanics")
    return tuple(
        one for one in effects if one.finite and not hasattr(one, "inner") and PLACES.index(one.place) <= last
    )


def answering(effects: Sequence[AbstractEffect]) -> tuple[AbstractEffect, ...]:
    """Those that do not act by themselves: what they change moves with driver and mechanics.

    A lag of the sensor and one of the driver do nearly the same, so that to tell them apart takes exact derivatives.
    """
    return tuple(one for one in effects if one.place not in _ALONE)


def dressed(chain: Chain, z: np.ndarray, effects: tuple[AbstractEffect, ...]) -> Chain:
    """The chain of a stage with effects in the same coordinates and columns."""
    if not effects:
        return chain
    coordinates = _Dressed(chain.coordinates, effects)
    return Chain(coordinates, place_of_hysteresis(coordinates(jnp.asarray(z))), chain.grid)  # type: ignore[arg-type]


def behind(chain: Chain, z: np.ndarray, run: Run, around_um: np.ndarray, moved_um: np.ndarray) -> np.ndarray:
    """Pass changes of the hysteresis on through what follows it and is not linear.

    Parameters
    ----------
    chain, z
        The stage; where all that follows its hysteresis is linear, changes have been passed on already.
    run
        The run.
    around_um
        What comes out of the hysteresis, shape `(n,)`.
    moved_um
        Changes of it, shape `(n, k)`.

    Returns
    -------
    Array
        Changes of the displacement, to first order, shape `(n, k)`.
    """
    assert chain.place is not None
    stage = chain.coordinates(jnp.asarray(z))
    after = stage.parts[chain.place + 1 :]
    if not after or joined(after) is not None:
        return moved_um
    n, samples = len(run.record), run.samples
    pad = len(samples.weight) - n
    time_s = samples.time_s * samples.stride if samples.time_s.ndim == 0 else samples.time_s[:: samples.stride]
    signal = jnp.asarray(np.pad(around_um, (0, pad), mode="edge"))
    out = np.empty_like(moved_um)
    for first in range(0, moved_um.shape[1], _TOGETHER):
        part = moved_um[:, first : first + _TOGETHER].T
        more = _TOGETHER - len(part)
        full = np.pad(part, ((0, more), (0, pad)))
        answer = _behind(chain.coordinates, chain.place, jnp.asarray(z), time_s, signal, jnp.asarray(full))
        out[:, first : first + _TOGETHER] = np.asarray(answer)[: len(part), :n].T
    return out


@eqx.filter_jit
def _behind(
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
