"""The records that a sweep fits or diagnoses: files that a pattern finds, or simulations with noise."""

import math
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from fits.io._errors import DataError, shown
from fits.io._read_csv import read_csv
from fits.io._record import Record
from fits.io._units import parse_columns
from fits.machining._design import nearest
from fits.sweeps._devices import place
from fits.sweeps._jobs import Request
from fits.sweeps._kinds_simulate import drive, table_of
from fits.sweeps._programs import Program, number, read_program
from fits.sweeps._stages import memory_before, requested_stage, respond, stage_parameters
from fits.sweeps._types import FloatArray, Parameter
from microid import Stage

_KEYS = ("files", "columns", "noise_um")
_NOISE = "records.noise_um"


@dataclass(frozen=True)
class Files:
    """Records in CSV files.

    Attributes
    ----------
    folder, names
        Where they are, and their names in it.
    columns
        Mapping of columns, as `read_csv` takes it.
    """

    folder: Path
    names: tuple[str, ...]
    columns: dict[str, str]

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Nothing about a file can be varied."""
        return ()

    def records(
        self, values: Mapping[str, FloatArray], rows: NDArray[np.int64], sources: NDArray[np.int64], seed: int
    ) -> list[Record | str]:
        """Read the file of each row; a sentence stands for one that cannot be read."""
        del values, seed
        found: dict[int, Record | str] = {}
        for source in np.unique(sources):
            path = self.folder / self.names[source]
            try:
                found[int(source)] = read_csv(path, self.columns)
            except DataError as error:
                found[int(source)] = str(error).replace(str(path), self.names[source])
        return [found[int(source)] for source in sources[: len(rows)]]


@dataclass(frozen=True)
class Simulated:
    """Records made by a stage under a program, with white noise of the sensor.

    Attributes
    ----------
    stage, program, initial
        See `SimulateJob`.
    noise_um
        Standard deviation where it does not vary.
    names, relative
        Parameters that vary, and which of them as factors.
    """

    stage: Stage
    program: Program
    initial: str
    noise_um: float
    names: tuple[str, ...]
    relative: tuple[str, ...]

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """What may be varied: the stage, the program and the noise."""
        noise = Parameter(_NOISE, "um", self.noise_um, 0.0)
        return (*stage_parameters(self.stage), *self.program.parameters, noise)

    def records(
        self, values: Mapping[str, FloatArray], rows: NDArray[np.int64], sources: NDArray[np.int64], seed: int
    ) -> list[Record | str]:
        """Simulate the record of each row; its noise depends on the seed and the row's number alone."""
        del sources
        own = tuple(parameter.name for parameter in self.parameters)
        names = tuple(name for name in self.names if name in own)
        table = place(table_of(values, names, len(rows)))
        given = None if self.program.given is None else jnp.asarray(self.program.given)
        voltage = drive(table, names, self.program, given)
        memory = memory_before(self.stage, self.initial)
        interval_s = jnp.asarray(self.program.interval_s)
        displacement = respond(self.stage, table, names, self.relative, interval_s, voltage, memory)
        time_s = np.arange(self.program.samples) * self.program.interval_s
        sd = values.get(_NOISE, np.full(len(rows), 1.0 if _NOISE in self.relative else self.noise_um))
        sd = sd * self.noise_um if _NOISE in self.relative else sd
        found: list[Record | str] = []
        pairs = zip(rows, sd, *jax.device_get((voltage, displacement)), strict=True)
        for row, spread, v, w in pairs:
            noise = np.random.default_rng([seed, int(row)]).normal(0.0, 1.0, len(w))
            fine = np.all(np.isfinite(w))
            found.append(
                Record(np.asarray(time_s, dtype=np.float64), v, w + spread * noise, source=f"row {row}")
                if fine
                else "the simulated displacement is not finite"
            )
        return found


def requested_records(request: Request) -> Files | Simulated:
    """What a sweep says of its records; a `DataError` says what is wrong with it."""
    table = request.table.get("records", {})
    for key in table:
        if key not in _KEYS:
            raise DataError(f"records.{key}: expected a known key, found {shown(key)}; {nearest(key, _KEYS)}")
    if "files" not in table:
        stage, initial = requested_stage(request)
        program = read_program(request.table.get("program", {"shape": "sine"}), "program", "V", request.load)
        noise = number(table.get("noise_um", 0.01), "records.noise_um")
        if noise < 0 or not math.isfinite(noise):
            raise DataError(f"records.noise_um: expected 0 um or more, found {noise:g}; correct it.")
        return Simulated(stage, program, initial, noise, request.names, request.relative)
    for key in ("model", "program"):
        if key in request.table:
            raise DataError(f"{key}: records come from files here; leave out {key}, or records.files.")
    pattern = table["files"]
    if not isinstance(pattern, str) or os.path.isabs(pattern) or request.folder is None:
        raise DataError(f"records.files: expected a pattern such as data/*.csv, found {shown(pattern)}; correct it.")
    try:
        files = [path for path in request.folder.glob(pattern) if path.is_file()]
        names = tuple(sorted(str(path.relative_to(request.folder)) for path in files))
    except (ValueError, NotImplementedError, OSError) as error:
        raise DataError(
            f"records.files: expected a pattern such as data/*.csv, found {shown(pattern)} ({error}); correct it."
        ) from None
    if not names:
        raise DataError(f"records.files: the axis is empty: no file matches {pattern}; correct the pattern.")
    return Files(request.folder, names, parse_columns(str(table.get("columns", ""))))
