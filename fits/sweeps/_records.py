"""The records that a sweep fits or diagnoses: files that a pattern finds, or simulations with noise."""

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import jax
import msgspec
import numpy as np
from msgspec import Meta

from fits.io._errors import DataError, shown
from fits.io._read_csv import read_table
from fits.io._record import Record
from fits.io._typed import typed
from fits.io._units import parse_columns
from fits.loop._plain import INITIAL_STATES
from fits.loop._result import FitError
from fits.sweeps._devices import on_cpu
from fits.sweeps._stages import Program, read_program, requested_stage, simulated, stage_parameters
from fits.sweeps._types import Block, Output, Parameter, Request, Rows
from microid import Stage

_NOISE = "records.noise_um"
# Options of what is done with records.
Holdout = Annotated[float, Meta(ge=0, le=0.9, description="a share between 0 and 0.9")]
_Word = Literal["unknown", "negative", "positive", "demagnetised"]
Initial = Annotated[_Word | None, Meta(description=f"one of {', '.join(INITIAL_STATES)}")]


class _Table(msgspec.Struct):
    """The table `[records]`."""

    files: Annotated[str | None, Meta(description="a pattern such as data/*.csv")] = None
    columns: str = ""
    sample_rate_Hz: float | None = None
    missing: Annotated[Literal["refuse", "drop"], Meta(description="refuse or drop")] = "refuse"
    noise_um: Annotated[float, Meta(ge=0, le=1e30, description="0 um or more")] = 0.01


@dataclass(frozen=True)
class Files:
    """Records in files: their folder, their names in it, and how they are read, as `read_table` takes it."""

    folder: Path
    sources: tuple[str, ...]
    how: dict[str, Any]
    # Nothing about a file can be varied.
    parameters: tuple[Parameter, ...] = ()

    def records(self, block: Block) -> list[Record | str]:
        """Read the file of each row; a sentence stands for one that cannot be read."""
        found: dict[int, Record | str] = {}
        for source in set(block.sources.tolist()):
            path = self.folder / self.sources[source]
            try:
                found[source] = read_table(path, **self.how)
            except DataError as error:
                found[source] = str(error).replace(str(path), self.sources[source])
        return [found[source] for source in block.sources.tolist()]


@dataclass(frozen=True)
class Simulated:
    """Records made by a stage under a program, with white noise of a sensor, whose standard deviation is given."""

    stage: Stage
    program: Program
    initial: str
    noise_um: float
    # They are made by the axes alone.
    sources: tuple[str, ...] = ()

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """What may be varied: the stage, the program and the noise."""
        own = Parameter(_NOISE, "um", self.noise_um, 0.0)
        return *stage_parameters(self.stage), *self.program.parameters, own

    def records(self, block: Block) -> list[Record | str]:
        """Simulate the record of each row; its noise depends on the seed and the row's number alone."""
        time_s = np.asarray(np.arange(self.program.samples) * self.program.interval_s, dtype=np.float64)
        sd_um = block.numbers(_NOISE, self.noise_um)
        signals = jax.device_get(simulated(self.stage, self.program, self.initial, block))
        found: list[Record | str] = []
        for row, sd, v, w in zip(block.rows, sd_um, *signals, strict=True):
            if np.all(np.isfinite(w)):
                noise = np.random.default_rng([block.seed, int(row)]).normal(0.0, 1.0, len(w))
                found.append(Record(time_s, v, w + sd * noise, source=f"row {row}"))
            else:
                found.append("the simulated displacement is not finite")
        return found


def requested_records(request: Request) -> Files | Simulated:
    """What a sweep says of its records; a `DataError` says what is wrong with it."""
    table = typed(request.table.get("records", {}), _Table, "records")
    pattern = table.files
    if pattern is None:
        stage, initial = requested_stage(request)
        program = read_program(request.table.get("program", {"shape": "sine"}), "program", "V", request.load)
        return Simulated(stage, program, initial, table.noise_um)
    for key in ("model", "program"):
        if key in request.table:
            raise DataError(f"{key}: records come from files here; leave out {key}, or records.files.")
    expected = f"records.files: expected a pattern such as data/*.csv, found {shown(pattern)}"
    if os.path.isabs(pattern) or request.folder is None:
        raise DataError(f"{expected}; correct it.")
    try:
        files = [path for path in request.folder.glob(pattern) if path.is_file()]
        names = tuple(sorted(str(path.relative_to(request.folder)) for path in files))
    except (ValueError, NotImplementedError, OSError) as error:
        raise DataError(f"{expected} ({error}); correct it.") from None
    if not names:
        raise DataError(f"records.files: the axis is empty: no file matches {pattern}; correct the pattern.")
    how = {"columns": parse_columns(table.columns), "sample_rate_Hz": table.sample_rate_Hz, "missing": table.missing}
    return Files(request.folder, names, how)


def each_alone(
    outputs: Sequence[Output], records: Sequence[Record | str], find: Callable[..., dict[str, Any]], *options: Any
) -> Rows:
    """Rows of what is found in one record after the other, each with its options, or why nothing is.

    On a CPU: what is computed for one record is a chain of small programs.
    """
    found: list[dict[str, Any] | str] = []
    with on_cpu():
        for record, *own in zip(records, *options, strict=True):
            try:
                found.append(record if isinstance(record, str) else find(record, *own))
            except (DataError, FitError) as error:
                found.append(" ".join(str(error).split()))
    return Rows.one_by_one(outputs, found)


def assumed_initial(request: Request, records: Files | Simulated) -> str:
    """Memory before each record, where the options say nothing of it: known of what is simulated."""
    return str(request.table.get("initial", "negative")) if isinstance(records, Simulated) else "unknown"
