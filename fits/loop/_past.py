"""What an unknown past adds to a run: the relays that its voltage has not swept yet, as unknowns of a regression.

Relays that switch between the lowest and the highest voltage that a run has reached are in known states. What the
others add is constant until the voltage goes beyond: a function of the highest voltage so far plus one of the lowest.
Where the voltage has gone beyond on the other side in between, fewer relays are left on this one, and that function
has a kink. Both are cubic splines here with some kinks, which end at nothing where the run does not go any farther;
what is left then is a constant, which the sensor's offset takes up.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

_DEGREE, _PIECES = 3, 5
# Kinks of either function, the highest power of what begins at each, and the part of the way that is left there.
_KINKS, _POWER, _LEFT = 4, 2, 0.02
# Times that the distance of a level from where a run begins is halved.
_CLOSER = 4


@jax.jit
def past_columns(voltage_V: Float[Array, " n"]) -> Float[Array, "n k"]:
    """Signals of the unknown past of a hysteresis under a voltage, shape `(n, k)`."""
    most, least = lax.cummax(voltage_V), lax.cummin(voltage_V)
    columns = _spline(most), _kinks(most, -least), _spline(least), _kinks(-least, most)
    return jnp.concatenate(columns, axis=1)


def rough_past_columns(
    voltage_V: Float[np.ndarray, " n"], levels_V: Float[np.ndarray, " l"]
) -> Float[np.ndarray, "n k"]:
    """Pieces, between levels, of the way that a hysteresis goes for the first time: ramps in V, shape `(n, k)`.

    A hysteresis of few plays has kinks there that no spline follows, and so has one that turned close around where
    the run begins: there the levels lie ever closer.
    """
    close_V = np.diff(levels_V).max() * np.outer([-1, 1], 0.5 ** np.arange(1, _CLOSER + 1)).ravel()
    levels_V = np.unique(np.clip(np.append(levels_V, voltage_V[0] + close_V), levels_V[0], levels_V[-1]))
    reached_V = np.maximum.accumulate(voltage_V), np.minimum.accumulate(voltage_V)
    ramps = np.concatenate([np.clip(one[:, None], levels_V[:-1], levels_V[1:]) for one in reached_V], axis=1)
    return (ramps - ramps[0])[:, ramps[-1] != ramps[0]]


def _spline(reached_V: Float[Array, " n"]) -> Float[Array, "n k"]:
    """Cubic splines of how far a run has still to go, shape `(n, k)`; zero where it goes no farther.

    B-splines, by the recurrence of C. de Boor, A Practical Guide to Splines (1978): sums over a run of truncated
    powers are so nearly singular that rounding decides what is fitted.
    """
    knots = np.concatenate([np.zeros(_DEGREE), np.linspace(0.0, 1.0, _PIECES + 1), np.ones(_DEGREE)])
    first, last = reached_V[0], reached_V[-1]
    left = (last - reached_V) / jnp.where(first == last, 1.0, last - first)
    # The last piece has its end, too.
    piece = jnp.minimum(jnp.floor(left * _PIECES), _PIECES - 1)[:, None]
    splines = (piece == np.arange(-_DEGREE, len(knots) - 1.0 - _DEGREE)[None]).astype(left.dtype)
    for degree in range(1, _DEGREE + 1):
        begins, ends = knots[: -degree - 1], knots[degree + 1 :]
        rise = (left[:, None] - begins[None]) * _inverse(knots[degree:-1] - begins)
        fall = (ends[None] - left[:, None]) * _inverse(ends - knots[1:-degree])
        splines = rise * splines[:, :-1] + fall * splines[:, 1:]
    # All but the first vanish where nothing is left.
    return splines[:, 1:]


def _kinks(reached_V: Float[Array, " n"], other_V: Float[Array, " n"]) -> Float[Array, "n k"]:
    """What a run has still to go beyond its worst kinks, and the squares of that, shape `(n, k)`.

    A kink is worse the farther the `other_V` has gone since the run was there, and the farther it is from both ends.
    """
    sample = jnp.arange(len(reached_V))
    farther = jnp.diff(reached_V, prepend=reached_V[:1]) > 0
    last = lax.cummax(jnp.where(farther, sample, 0))
    before = jnp.concatenate([last[:1], last[:-1]])
    at_V, gone_V = reached_V[before], other_V - other_V[before]
    way_V, end_V = reached_V[-1] - reached_V[0], reached_V[-1]
    least_V = jnp.minimum(at_V - reached_V[0], end_V - at_V)
    worth = jnp.where(farther & (least_V > _LEFT * way_V), gone_V * least_V, 0.0)
    most, which = lax.top_k(worth, min(_KINKS, len(reached_V)))
    kink_V = jnp.where(most > 0, at_V[which], end_V)
    width_V = jnp.where(most > 0, end_V - kink_V, 1.0)
    left = (end_V - jnp.maximum(reached_V[:, None], kink_V[None])) / width_V[None]
    return jnp.concatenate([left**power for power in range(1, _POWER + 1)], axis=1)


def _inverse(width: np.ndarray) -> np.ndarray:
    """One over widths, in a row; nothing where knots meet."""
    return np.divide(1.0, width, out=np.zeros_like(width), where=width > 0)[None]
