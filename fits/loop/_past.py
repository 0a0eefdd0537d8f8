"""What an unknown past adds to a run: the relays that its voltage has not swept yet, as unknowns of a regression.

Relays that switch between the lowest and the highest voltage that a run has reached are in known states. What the
others add is constant until the voltage goes beyond: a function of the highest voltage so far plus one of the lowest,
to first order in how much farther it goes each time. Both are cubic splines here, which end at nothing where the run
does not go any farther; what is left then is a constant, which the sensor's offset takes up.
"""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

# Pieces of the splines.
_PIECES = 5


def past_columns(voltage_V: Float[Array, " n"]) -> Float[Array, "n k"]:
    """Signals of the unknown past of a hysteresis under a voltage, shape `(n, k)`."""
    return jnp.concatenate([_spline(lax.cummax(voltage_V)), _spline(lax.cummin(voltage_V))], axis=1)


def _spline(reached_V: Float[Array, " n"]) -> Float[Array, "n k"]:
    """Cubic splines of how far a run has still to go, shape `(n, k)`; zero where it goes no farther."""
    first, last = reached_V[0], reached_V[-1]
    way = jnp.where(first == last, 1.0, last - first)
    left = (last - reached_V) / way
    powers = [left, left**2, *(jnp.maximum(left - k / _PIECES, 0.0) ** 3 for k in range(_PIECES))]
    return jnp.stack(powers, axis=1)
