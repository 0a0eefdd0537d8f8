"""A sweep as a TOML file describes it, checked before anything runs."""

import hashlib
import math
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta

from fits.io._errors import DataError, shown
from fits.io._read_file import MOST_CSV_BYTES, MOST_TOML_BYTES, parse_toml, read_bytes, read_text
from fits.io._typed import check_keys, typed
from fits.sweeps import kinds
from fits.sweeps._axes import Plan
from fits.sweeps._read_axes import read_plan
from fits.sweeps._types import SCHEMA, AbstractJob, Facts, Request

_COMMON = ("schema", "kind", "title", "seed", "axis", "design", "list", "run")
_MOST_MB = 1_000_000_000
# Keys of kinds that are words; all others are tables.
_NO_TABLES = ("model", "initial", "stage")


class _Run(msgspec.Struct):
    """The table `[run]`."""

    memory_MB: Annotated[float, Meta(ge=1, le=_MOST_MB, description=f"a number from 1 to {_MOST_MB:,}")] = 256.0
    chunk_rows: Annotated[Annotated[int, Meta(ge=1)] | None, Meta(description="a number of 1 or more")] = None


@dataclass(frozen=True)
class Sweep:
    """A sweep that can run: its TOML and where that is from, the files it names, its rows and what is done with each.

    `memory_MB` is what a chunk may take, `chunk_rows` its rows if they are stated; sources are in `folder`.
    """

    text: str
    name: str
    inputs: dict[str, bytes]
    kind: str
    seed: int
    plan: Plan
    job: AbstractJob
    facts: Facts
    memory_MB: float
    chunk_rows: int | None
    folder: Path | None = None

    @property
    def digest(self) -> str:
        """SHA-256 of the text, all files, and the names and contents of all sources: what the rows depend on.

        It is made anew each time, as sources may have changed; one that cannot be read counts as such.
        """
        parts: list[str | bytes] = [self.text]
        for source in self.facts.sources:
            parts += [source, _sum_of((self.folder or Path()) / source)]
        parts += [part for name in sorted(self.inputs) for part in (name, self.inputs[name])]
        sums = [hashlib.sha256(part.encode() if isinstance(part, str) else part).hexdigest() for part in parts]
        return hashlib.sha256("".join(sums).encode()).hexdigest()


def read_sweep(path: str | os.PathLike[str]) -> Sweep:
    """Read a sweep and all files it names; a `DataError` says what is not as it should be."""
    name = os.fspath(path)
    text = read_text(path, "the TOML of a sweep, such as 'microid sweep --example simulate' prints", MOST_TOML_BYTES)
    folder = Path(path).resolve().parent

    def load(file: str) -> bytes:
        try:
            return read_bytes(folder / file, "a file of the sweep", MOST_CSV_BYTES)
        except DataError as error:
            raise DataError(str(error).replace(str(folder / file), file)) from None

    return parse_sweep(text, name, load, folder)


def parse_sweep(text: str, name: str, load: Callable[[str], bytes], folder: Path | None = None) -> Sweep:
    """Make a sweep of its text; files come through `load`, and patterns of names stand for files in `folder`."""
    table = parse_toml(text, name)
    inputs: dict[str, bytes] = {}

    def kept(file: str) -> bytes:
        if file not in inputs:
            inputs[file] = load(file)
        return inputs[file]

    try:
        if table.get("schema") != SCHEMA:
            raise DataError(f'schema: expected "{SCHEMA}", found {shown(table.get("schema"))}; give that.')
        kind = table.get("kind")
        if not isinstance(kind, str) or kind not in kinds.names():
            raise DataError(f"kind: expected one of {', '.join(kinds.names())}, found {shown(kind)}; choose one.")
        made_by = kinds.kind(kind)
        tables = made_by.KEYS
        check_keys(table, [*_COMMON, *tables], "")
        for key in table:
            if key in tables and key not in _NO_TABLES and not isinstance(table[key], dict):
                raise DataError(
                    f"{key}: expected a table, found {shown(table[key])}; write [{key}] and its keys below."
                )
        seed = table.get("seed", 0)
        if isinstance(seed, bool) or not isinstance(seed, int) or seed < 0:
            raise DataError(f"seed: expected a whole number of 0 or more, found {shown(seed)}; correct it.")
        options = typed(table.get("run", {}), _Run, "run")
        chunk_rows = options.chunk_rows
        job = made_by.make(Request(table, kept, folder))
        facts = job.facts
        plan = read_plan(table, facts.parameters, max(1, len(facts.sources)), seed, kept)
        if chunk_rows is not None and chunk_rows % job.facts.block:
            raise DataError(
                f"run.chunk_rows: expected a multiple of {job.facts.block}, as so many rows are computed together, "
                f"found {chunk_rows}; correct it, or leave it out."
            )
        return Sweep(text, name, inputs, kind, seed, plan, job, facts, options.memory_MB, chunk_rows, folder)
    except DataError as error:
        raise DataError(f"{name}: {error}") from None


def _sum_of(path: Path) -> str:
    try:
        if not path.is_file():  # a pipe would be waited for
            return "unreadable"
        with open(path, "rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError:
        return "unreadable"


def outside(sweep: Sweep, values: Mapping[str, np.ndarray]) -> tuple[dict[str, np.ndarray], list[str]]:
    """Replace values out of bounds by nominal ones, and give the reason for each row that fails."""
    reasons = [""] * len(next(iter(values.values()), np.zeros(0)))
    kept = dict(values)
    parameters = {parameter.name: parameter for parameter in sweep.facts.parameters}
    for axis in sweep.plan.axes:
        parameter = parameters[axis.parameter]
        value = values[axis.parameter]
        lower, upper = (0.0, math.inf) if axis.relative else (parameter.lower, parameter.upper)
        wrong = ~((value >= lower) & (value <= upper))
        if wrong.any():
            kept[axis.parameter] = np.where(wrong, 1.0 if axis.relative else parameter.nominal, value)
            for k in np.flatnonzero(wrong):
                reasons[k] = reasons[k] or (
                    f"{parameter.name} = {value[k]:.6g} lies outside its bounds, "
                    f"{f'{lower:g} to {upper:g} times its own' if axis.relative else parameter.range_words}"
                )
    return kept, reasons
