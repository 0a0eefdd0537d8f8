"""What a rig must have been through before its record, from the samples that depend on it."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from microid import Preisach, Staircase

# Pairs of extremes that stand for the unknown history, and samples that are compared.
_PAIRS = 6
_SAMPLES = 1024
_SIZE = 64
# Share of the way that stands for none.
_LEAST = 1e-3


def closing_staircase(z: Float[Array, "2 pairs_1"], model: Preisach, first_V: Float[Array, ""]) -> Staircase:
    """Extremes that close in on the first voltage, by the shares of the way that coordinates stand for.

    They stand for the minima and, in the second row, for the maxima: logarithms of the shares of the way from an end
    of the range, up to a constant.
    """
    below, above = jax.nn.softmax(z[0]), jax.nn.softmax(z[1])
    low, high = model.density.lower_V, model.density.upper_V
    minima = low + (first_V - low) * jnp.cumsum(below)[:-1]
    maxima = high - (high - first_V) * jnp.cumsum(above)[:-1]
    inner = jnp.stack([maxima, minima], axis=1).ravel()
    extremes = jnp.concatenate([low[None], inner, first_V[None]])
    used = extremes.shape[0]
    return Staircase(jnp.pad(extremes, (0, _SIZE - used), mode="edge"), jnp.asarray(used, dtype=jnp.int32))


def closing_coordinates(start: Staircase, model: Preisach, first_V: float) -> Float[np.ndarray, "2 pairs_1"]:
    """The coordinates of extremes that close in on the first voltage; where they do not, as near as they come."""
    extremes = np.asarray(start.extremes_V)[1 : int(start.count) - 1]
    rows = []
    for end_V, inner_V in ((model.density.lower_V, extremes[1::2]), (model.density.upper_V, extremes[::2])):
        way_V = np.abs(np.diff(np.concatenate([[float(end_V)], inner_V, [first_V]])))
        rows.append(np.log(np.maximum(way_V / max(float(np.sum(way_V)), 1e-300), _LEAST)))
    return np.stack([row - np.mean(row) for row in rows])


def _residual(
    z: Float[Array, "2 pairs_1"], args: tuple[Preisach, Float[Array, " n"], Float[Array, " n"], Float[Array, " n"]]
) -> Float[Array, " m"]:
    model, voltage_V, displacement_um, weight = args
    start = closing_staircase(z, model, voltage_V[0])
    # A faint pull towards an even decay decides what the samples leave open.
    return jnp.concatenate([weight * (model(voltage_V, start) - displacement_um), 1e-2 * z.ravel()])


@eqx.filter_jit
def _solve(args: tuple[Preisach, Array, Array, Array]) -> Staircase:
    solver: Any = optx.LevenbergMarquardt(rtol=1e-6, atol=1e-6)
    start = jnp.zeros((2, _PAIRS + 1))
    solution: Any = optx.least_squares(_residual, solver, start, args=args, max_steps=100, throw=False)
    return closing_staircase(solution.value, args[0], args[1][0])


def estimate_start(
    model: Preisach, voltage_V: Float[np.ndarray, " n"], displacement_um: Float[np.ndarray, " n"], noise_um: float
) -> Staircase:
    """Fit the memory before the first of the samples that depend on it; the model has the offset of their run.

    The output is differentiable in the remembered extremes as it is in any voltage, so the extremes themselves are
    the unknowns (Levenberg-Marquardt on `2 x 7` shares of the way from the ends of the range to the first sample).
    """
    keep = np.arange(len(voltage_V))
    # Thinned out evenly; the extremes of the path must stay, as they make the memory.
    if len(keep) > _SAMPLES:
        turns = 1 + np.flatnonzero(np.diff(np.sign(np.diff(voltage_V))) != 0)
        even = np.linspace(0, len(keep) - 1, max(2, _SAMPLES - len(turns))).astype(np.int64)
        keep = np.unique(np.concatenate([even, turns]))[: 2 * _SAMPLES]
    pad = (0, 2 * _SAMPLES - len(keep))
    voltage = np.pad(voltage_V[keep], pad, mode="edge")
    displacement, weight = (np.pad(x, pad) for x in (displacement_um[keep], np.full(len(keep), 1 / noise_um)))
    return _solve((model, jnp.asarray(voltage), jnp.asarray(displacement), jnp.asarray(weight)))
