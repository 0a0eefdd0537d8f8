"""The inverse as a network, as papers have it: identified from a record with its columns swapped. For comparison."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax import lax
from jaxtyping import Array, Float

from fits.io._errors import DataError
from fits.io._record import Record
from microid import negative_saturation, remember

_FEWEST = 200
_TOLERANCE = 1e-8


class NetworkInverse(eqx.Module):
    """A network from a displacement, and what is remembered of it, to a voltage.

    Use `compensate`, or `microid.invert`, instead: they invert the model exactly, whatever the reference. This is
    what they are compared with. A network is sure of nothing beyond the loops that it has seen.

    The network takes the displacement, its direction and so many remembered extremes, newest first; all from -1 to 1
    over the range of the displacements it was trained on, as its voltage is about the middle of theirs, by half their
    width. Turns by less than `dead_um` are not remembered: they are noise.
    """

    network: eqx.nn.MLP
    lowest_um: Float[Array, ""]
    span_um: Float[Array, ""]
    middle_V: Float[Array, ""]
    half_V: Float[Array, ""]
    dead_um: Float[Array, ""]
    extremes: int = eqx.field(static=True)

    def __call__(self, displacement_um: Float[Array, " n"]) -> Float[Array, " n"]:
        """Voltage in V for a displacement that came up from below its range, shape `(n,)`."""
        return self.middle_V + self.half_V * jax.vmap(self.network)(self.features(displacement_um))

    @eqx.filter_jit
    def features(self, displacement_um: Float[Array, " n"]) -> Float[Array, "n k"]:
        """What the network sees of a displacement, shape `(n, 2 + extremes)`."""

        def follow(centre: Float[Array, ""], value: Float[Array, ""]) -> tuple[Array, Array]:
            centre = jnp.clip(centre, value - self.dead_um, value + self.dead_um)
            return centre, centre

        _, steady = lax.scan(follow, displacement_um[0], displacement_um)
        memory = remember(jnp.maximum(steady, self.lowest_um), negative_saturation(self.lowest_um, 4))
        entry, seen = jnp.arange(memory.lead, memory.path_V.shape[0]), []
        for _ in range(self.extremes):
            entry = memory.anchor[entry]
            seen.append(memory.path_V[entry])
        levels = 2 * (jnp.stack([displacement_um, *seen], axis=1) - self.lowest_um) / self.span_um - 1
        direction = jnp.where(memory.rising[memory.lead :], 1.0, -1.0)
        return jnp.concatenate([levels, direction[:, None].astype(levels.dtype)], axis=1)


def fit_network_inverse(
    record: Record,
    *,
    width: int = 12,
    depth: int = 2,
    extremes: int = 3,
    samples: int = 1000,
    steps: int = 60,
    noise_um: float = 0.0,
    seed: int = 0,
) -> NetworkInverse:
    """Train a network to give the voltage of a measured displacement. For comparison: see `NetworkInverse`.

    The record begins at negative saturation. Width and depth are those of the network's hidden layers. It is trained
    on at most so many samples, evenly spaced, in at most so many steps of the Levenberg-Marquardt method. The noise
    is the standard deviation of the sensor's, the seed that of the first weights. A `DataError` says that the record
    has no displacement, or too little of it, or nothing moves in it.
    """
    if record.displacement_um is None:
        raise DataError(f"{record.source}: a displacement column is needed here; give one.")
    displacement, voltage = record.displacement_um, record.voltage_V
    if len(record) < _FEWEST or np.ptp(displacement) == 0 or np.ptp(voltage) == 0:
        raise DataError(
            f"{record.source}: expected {_FEWEST} samples or more in which voltage and displacement move, found "
            f"{len(record)}; give a longer record."
        )
    network = _network(2 + extremes, "scalar", width, depth, activation=jnp.tanh, key=jax.random.key(seed))
    middle, half = (voltage.max() + voltage.min()) / 2, np.ptp(voltage) / 2
    numbers = displacement.min(), np.ptp(displacement), middle, half, 4.0 * noise_um
    lowest_um, span_um, middle_V, half_V, dead_um = map(jnp.asarray, numbers)
    inverse = NetworkInverse(network, lowest_um, span_um, middle_V, half_V, dead_um, extremes)
    chosen = np.linspace(0, len(record) - 1, min(samples, len(record))).astype(int)
    seen = inverse.features(jnp.asarray(displacement))[chosen]
    trained = _train(network, seen, jnp.asarray((voltage[chosen] - middle) / half), steps)
    return eqx.tree_at(lambda inverse: inverse.network, inverse, trained)


_network = eqx.filter_jit(eqx.nn.MLP)


@eqx.filter_jit
def _train(network: eqx.nn.MLP, seen: Float[Array, "n k"], wanted: Float[Array, " n"], steps: int) -> eqx.nn.MLP:
    weights, rest = eqx.partition(network, eqx.is_inexact_array)

    def residual(weights: eqx.nn.MLP, data: tuple[Array, Array]) -> Float[Array, " n"]:
        return jax.vmap(eqx.combine(weights, rest))(data[0]) - data[1]

    solver: Any = optx.LevenbergMarquardt(rtol=_TOLERANCE, atol=_TOLERANCE)
    # Out of steps is where training ends, not a failure.
    found: Any = optx.least_squares(residual, solver, weights, args=(seen, wanted), max_steps=steps, throw=False)
    return eqx.combine(found.value, rest)
