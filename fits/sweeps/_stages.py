"""What a sweep simulates: a model file or a nominal stage, the signals that drive it, and the parameters of both."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import msgspec
import numpy as np
from jaxtyping import Array, Float, Int
from msgspec import Meta

import microid as m
from fits.control._tune import parameter_values
from fits.io._errors import DataError, shown
from fits.io._open_table import open_table
from fits.io._plausible import SHORTEST_STEP_s
from fits.io._read_csv import read_reference, read_table
from fits.io._typed import check_keys, typed
from fits.io._units import recognise
from fits.stage._model_file import load_model
from fits.stage._run import as_stage
from fits.sweeps._devices import by_rows, place
from fits.sweeps._types import Block, FloatArray, Parameter, Request, in_a_file, number, one_of

NOMINAL = "nominal"
INITIAL = ("negative", "positive", "demagnetised")
_LEVELS, _LOOPS_um, _SLOPE_um_per_V = 16, 5.0, 0.1
# Share of the range over which the density of relays falls by e away from the diagonal.
_DENSITY_WIDTH = 0.2
# Parameters of each shape beside offset and amplitude, with their defaults.
_WAVE = {"frequency_Hz": 10.0, "phase_rad": 0.0}
SHAPES: dict[str, dict[str, float]] = {
    "sine": _WAVE,
    "triangle": _WAVE,
    "decay": _WAVE,
    "chirp": {"frequency_Hz": 10.0, "frequency_end_Hz": 100.0, "phase_rad": 0.0},
    "step": {"step_s": 0.0},
    "file": {},
}
_UNITS = {"frequency_Hz": "Hz", "frequency_end_Hz": "Hz", "phase_rad": "rad", "step_s": "s", "gain": "1"}
_SAMPLES, _LONGEST_s = 10_000_000, 1e4


class _Times(msgspec.Struct):
    """When a signal of a shape is sampled."""

    samples: Annotated[int, Meta(ge=3, le=_SAMPLES, description=f"a number from 3 to {_SAMPLES:,}")] = 1000
    interval_s: Annotated[
        float,
        Meta(ge=SHORTEST_STEP_s, le=_LONGEST_s, description=f"a time from {SHORTEST_STEP_s:g} to {_LONGEST_s:g} s"),
    ] = 1e-4


@dataclass(frozen=True)
class Program:
    """A signal over even times, of one of `SHAPES` or of a file; `nominal` values are by name within its table."""

    table: str
    unit: str
    shape: str
    samples: int
    interval_s: float
    nominal: tuple[tuple[str, float], ...]
    given: FloatArray | None = field(default=None, compare=False)

    @property
    def last_s(self) -> float:
        """Time of the last sample."""
        return (self.samples - 1) * self.interval_s

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        found = []
        for name, nominal in self.nominal:
            unit = _UNITS.get(name, self.unit)
            lower, upper = 0.0 if unit == "Hz" else -math.inf, self.last_s if unit == "s" else math.inf
            found.append(Parameter(f"{self.table}.{name}", unit, nominal, lower, upper))
        return tuple(found)

    def signal(self, values: Mapping[str, Float[Array, ""]], given: Float[Array, " t"] | None) -> Float[Array, " t"]:
        """The signal of one row, shape `(samples,)`; parameters that are not given have their nominal values."""
        at = {name: jnp.asarray(value) for name, value in self.nominal}
        at |= {name: values[f"{self.table}.{name}"] for name in at if f"{self.table}.{name}" in values}
        offset = at[f"offset_{self.unit}"]
        if given is not None:
            return offset + at["gain"] * given
        time, whole = jnp.arange(self.samples, dtype=float) * self.interval_s, self.samples * self.interval_s
        if self.shape == "step":
            shape = (time >= at["step_s"]).astype(time.dtype)
        else:
            turns = at["frequency_Hz"] * time + at["phase_rad"] / (2 * math.pi)
            if self.shape == "chirp":
                turns = turns + (at["frequency_end_Hz"] - at["frequency_Hz"]) * time**2 / (2 * whole)
            triangle = self.shape == "triangle"
            shape = 1 - 4 * jnp.abs((turns + 0.25) % 1 - 0.5) if triangle else jnp.sin(2 * math.pi * turns)
            if self.shape == "decay":
                shape = shape * (1 - time / whole)
        return offset + at[f"amplitude_{self.unit}"] * shape

    def wanted(self) -> FloatArray:
        """The nominal signal, shape `(samples,)`."""
        given = None if self.given is None else jnp.asarray(self.given)
        return np.asarray(self.signal({}, given), dtype=np.float64)


def read_program(table: Mapping[str, Any], name: str, unit: str, load: Callable[[str], bytes]) -> Program:
    """Read the table `[program]` or `[reference]` of a sweep; a `DataError` says what is wrong with it."""
    shape = one_of(SHAPES, table.get("shape", "file" if "file" in table else None), f"{name}.shape", "choose one.")
    nominal = {f"offset_{unit}": 0.0, "gain": 1.0}
    if shape != "file":
        nominal = {f"offset_{unit}": 0.0, f"amplitude_{unit}": 1.0} | SHAPES[shape]
    times = ("file",) if shape == "file" else _Times.__struct_fields__
    check_keys(table, ["shape", *times, *nominal], name)
    nominal |= {key: number(table[key], f"{name}.{key}") for key in nominal if key in table}
    if shape == "file":
        given, interval_s = _read_signal(table.get("file"), name, unit, load)
        return Program(name, unit, shape, len(given), interval_s, tuple(nominal.items()), given)
    even = typed({key: table[key] for key in times if key in table}, _Times, name)
    program = Program(name, unit, shape, even.samples, even.interval_s, tuple(nominal.items()))
    for each in program.parameters:
        if not each.lower <= each.nominal <= each.upper:
            raise DataError(
                f"{each.name}: expected {each.lower:g} to {each.upper:g} {each.unit}, found {each.nominal:g}; "
                "correct it."
            )
    return program


def _read_signal(path: Any, name: str, unit: str, load: Callable[[str], bytes]) -> tuple[FloatArray, float]:
    """The signal of a file, and its interval."""
    if not isinstance(path, str):
        raise DataError(f"{name}.file: expected the name of a CSV file, found {shown(path)}; give one.")
    column = f"{'voltage' if unit == 'V' else 'displacement'}_{unit}"

    def read(file: Path) -> tuple[FloatArray, FloatArray]:
        # What is no record is refused before anything of it is shown.
        if not any(map(recognise, open_table(file).names)):
            raise DataError(
                f"{file}: expected the columns time_s and {column}, found none that is known; name another."
            )
        record = read_table(file, required=("time_s", column)) if unit == "V" else read_reference(file)
        return record.time_s, getattr(record, column)

    time_s, given = in_a_file(load(path), path, read)
    interval = np.diff(time_s)
    if np.ptp(interval) > 1e-3 * np.mean(interval):
        raise DataError(f"{name}.file: {path} is not sampled evenly, which a sweep needs; resample it.")
    return given, float(np.mean(interval))


def drive(program: Program, block: Block, values: Mapping[str, Array]) -> Float[Array, "n t"]:
    """Signals of all rows of a block, by the values that vary."""
    given = None if program.given is None else jnp.asarray(program.given)
    return _drive(place(block.rows), values, program, given)


@by_rows("rows", "values")
def _drive(
    rows: Int[Array, " n"], values: Mapping[str, Array], program: Program, given: Float[Array, " t"] | None
) -> Float[Array, "n t"]:
    return jax.vmap(lambda _, own: program.signal(own, given))(rows, values)


def nominal_stage() -> m.Stage:
    """A stage of common size: 0 to 120 V, 17 um, loops of some 15 %, 1 ms, 200 Hz and a damping ratio of 0.03."""
    lower, upper = jnp.asarray(0.0), jnp.asarray(120.0)
    i, j = np.tril_indices(_LEVELS)
    density = np.exp(-(i - j) / (_LEVELS - 1) / _DENSITY_WIDTH) * m.densities.node_areas(_LEVELS)[i, j]
    grid = m.densities.GridDensity(jnp.asarray(_LOOPS_um * density / density.sum()), lower, upper)
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
