"""Where the hysteresis of a stage had turned before a record, by all that the stage does in it."""

from dataclasses import replace
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from fits.loop._estimate_start import closing_coordinates, closing_staircase
from fits.loop._run import Run, Samples
from fits.stage._run import (
    ahead,
    hysteresis_of,
    nuisance_columns,
    place_of_hysteresis,
    respond,
    spanned,
    yields_inside,
)
from microid import Preisach, Stage, Staircase, innermost

# A faint pull, in standard deviations, that decides what samples leave open, and steps of the solver at most.
_PULL, _STEPS = 1e-2, 256


def memory_behind(stage: Stage, run: Run, start: Staircase, noise_um: float) -> Staircase:
    """The memory before a run from a guess, all that follows the hysteresis answering to it.

    The noise is that of the sensor: in units of more the solver would stop short of what is left to find. What the
    driver was charged with, how the stage moved, and what else a past adds are fitted beside it, as to any run.
    """
    place, law = place_of_hysteresis(stage), innermost(hysteresis_of(stage))
    if place is None or not isinstance(law, Preisach) or yields_inside(stage) or int(start.count) < 3:
        return start
    samples = run.coarser.samples
    first_V = ahead(stage, place, samples).values[0]
    weight = np.sqrt(np.asarray(samples.weight))
    columns = weight[:, None] * np.asarray(nuisance_columns(stage, samples))
    basis = spanned(columns)
    # Of one shape, whatever its rank.
    padded = jnp.asarray(np.pad(basis, ((0, 0), (0, columns.shape[1] - basis.shape[1]))))
    guess = jnp.asarray(closing_coordinates(start, law, float(first_V)))
    given = stage, samples, padded, jnp.asarray(weight / noise_um), first_V
    # An even decay is where the guess itself began, and may lead elsewhere.
    found = [_solved(z, given) for z in (guess, jnp.zeros_like(guess))]
    return closing_staircase(min(found, key=lambda one: float(one[1]))[0], law, first_V)


_Given = tuple[Stage, Samples, Float[Array, "n k"], Float[Array, " n"], Float[Array, ""]]


def _left(z: Float[Array, "2 pairs_1"], given: _Given) -> Float[Array, " m"]:
    stage, samples, basis, weight, first_V = given
    law: Any = innermost(hysteresis_of(stage))
    start = replace(samples.start, memory=closing_staircase(z, law, first_V))
    off = weight * (samples.displacement_um - respond(stage, replace(samples, start=start)))
    return jnp.concatenate([off - basis @ (basis.T @ off), _PULL * z.ravel()])


@eqx.filter_jit
def _solved(z: Float[Array, "2 pairs_1"], given: _Given) -> tuple[Float[Array, "2 pairs_1"], Float[Array, ""]]:
    """Coordinates, and the sum of squares that they leave."""
    solver: Any = optx.LevenbergMarquardt(rtol=1e-5, atol=1e-5)
    solution: Any = optx.least_squares(_left, solver, z, args=given, max_steps=_STEPS, throw=False)
    return solution.value, jnp.sum(_left(solution.value, given) ** 2)
