"""The stage that a sweep simulates: a model file or a nominal one, and how its parameters are named and set."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import microid as m
from fits.control._tune import parameter_values
from fits.io._errors import DataError, shown
from fits.stage._model_file import load_model
from fits.stage._run import as_stage
from fits.sweeps._devices import by_rows, place
from fits.sweeps._programs import Program, drive
from fits.sweeps._types import Block, Parameter, Request, in_a_file, one_of

NOMINAL = "nominal"
INITIAL = ("negative", "positive", "demagnetised")
_LEVELS, _LOOPS_um, _SLOPE_um_per_V = 16, 5.0, 0.1
# Share of the range over which the density of relays falls by e away from the diagonal.
_DENSITY_WIDTH = 0.2


def nominal_stage() -> m.Stage:
    """A stage of common size: 0 to 120 V, 17 um, loops of some 15 %, 1 ms, 200 Hz and a damping ratio of 0.03."""
    lower, upper = jnp.asarray(0.0), jnp.asarray(120.0)
    i, j = np.tril_indices(_LEVELS)
    density = np.exp(-(i - j) / (_LEVELS - 1) / _DENSITY_WIDTH) * m.node_areas(_LEVELS)[i, j]
    grid = m.GridDensity(jnp.asarray(_LOOPS_um * density / density.sum()), lower, upper)
    slope = m.Reversible(jnp.full(_LEVELS, _SLOPE_um_per_V), lower, upper)
    return m.Stage.of(
        driver=m.Driver(jnp.asarray(1e-3)),
        hysteresis=m.Preisach(grid, slope, jnp.asarray(0.0)),
        mechanics=m.Mechanics(jnp.asarray(200.0), jnp.asarray(0.03)),
    )


def requested_stage(request: Request) -> tuple[m.Stage, str]:
    """The stage and the initial memory that a sweep names by `model` and `initial`."""
    name, initial = request.table.get("model", NOMINAL), request.table.get("initial", INITIAL[0])
    if not isinstance(name, str):
        raise DataError(f'model: expected "{NOMINAL}" or the name of a model file, found {shown(name)}; give one.')
    initial = one_of(INITIAL, initial, "initial", "choose one.")
    model = nominal_stage() if name == NOMINAL else in_a_file(request.load(name), name, load_model).model
    if not isinstance(model, m.Preisach | m.Stage):
        raise DataError(
            f"{name}: expected a stage or a Preisach model, found a {type(model).__name__}; fit one first."
        )
    return as_stage(model), initial


def stage_parameters(stage: m.Stage) -> tuple[Parameter, ...]:
    """Everything about a stage that can be varied, by its name in the stage."""
    values, found = parameter_values(stage), []
    for info in m.parameter_table(stage):
        nominal, spec = float(values[info.path]) if info.shape == () else math.nan, info.spec
        found.append(Parameter(stage.named(info.path), spec.unit, nominal, spec.lower, spec.upper))
    return tuple(found)


def varied(stage: m.Stage, values: Mapping[str, Float[Array, "..."]], relative: Sequence[str]) -> m.Stage:
    """Return a stage, perhaps of rows, with other values of some parameters; relative ones are factors."""
    names = {info.path: stage.named(info.path) for info in m.parameter_table(stage)}

    def changed(path: Any, leaf: Any) -> Any:
        name = names.get(jax.tree_util.keystr(path).lstrip("."), "")
        if name not in values:
            return leaf
        factor = jnp.reshape(values[name], jnp.shape(values[name]) + (1,) * (leaf.ndim - jnp.ndim(values[name])))
        return leaf * factor if name in relative else jnp.asarray(values[name], leaf.dtype)

    return jax.tree_util.tree_map_with_path(changed, stage)


@by_rows("voltage_V", "values")
def respond(
    stage: m.Stage,
    values: Mapping[str, Float[Array, " n"]],
    relative: tuple[str, ...],
    interval_s: Float[Array, ""],
    voltage_V: Float[Array, "n t"],
    memory: m.Staircase | None,
) -> Float[Array, "n t"]:
    """Respond to commands, each row at rest under its first sample."""
    rows = jax.tree.map(lambda leaf: leaf[None], stage)
    return m.respond_all(varied(rows, values, relative), interval_s, voltage_V, memory)


def simulated(
    stage: m.Stage, program: Program, initial: str, block: Block
) -> tuple[Float[Array, "n t"], Float[Array, "n t"]]:
    """Commands in V of the rows of a block, and displacements in um that they make a stage respond with."""
    # In programs of their own: compiled as one, XLA computes much of it several times.
    values, interval_s = place(block.values), jnp.asarray(program.interval_s)
    voltage = drive(program, block, values)
    return voltage, respond(stage, values, block.relative, interval_s, voltage, memory_before(stage, initial))


def range_of(stage: m.Stage) -> tuple[float, float] | None:
    """Range of the hysteresis in V, None where there is none."""
    laws = [part for part in stage.parts if isinstance(part, m.Preisach)]
    return (float(laws[0].density.lower_V), float(laws[0].density.upper_V)) if laws else None


def memory_before(stage: m.Stage, initial: str) -> m.Staircase | None:
    """Memory of the hysteresis before a row, None where the stage has none of Preisach's."""
    limits = range_of(stage)
    if limits is None:
        return None
    if initial == "negative":
        return m.negative_saturation(limits[0], 1)
    if initial == "positive":
        return m.positive_saturation(*limits, 2)
    return m.demagnetised(*limits, size=16)
