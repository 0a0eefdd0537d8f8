"""A sweep as a TOML file describes it, checked before anything runs."""

import hashlib
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
from fits.sweeps._axes import Axis, Plan
from fits.sweeps._read_axes import read_plan
from fits.sweeps._types import SCHEMA, AbstractJob, Facts, Parameter, Request, one_of

_MOST_MB = 1_000_000_000


class _Run(msgspec.Struct):
    """The table `[run]`."""

    memory_MB: Annotated[float, Meta(ge=1, le=_MOST_MB, description=f"a number from 1 to {_MOST_MB:,}")] = 256.0
    chunk_rows: Annotated[Annotated[int, Meta(ge=1)] | None, Meta(description="a number of 1 or more")] = None


@dataclass(frozen=True)
class Sweep:
    """A sweep that can run: its TOML and its place, the files it names, its rows and what is done with each.

    Chunks take at most so much memory, or so many rows where `chunk_rows` is stated.
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
    def swept(self) -> list[tuple[Axis, Parameter]]:
        """The axes, each with the parameter that it varies."""
        known = {parameter.name: parameter for parameter in self.facts.parameters}
        return [(axis, known[axis.parameter]) for axis in self.plan.axes]

    @property
    def digest(self) -> str:
        """SHA-256 of the text, all files, and the names and contents of all sources as they are now."""
        parts = [self.text.encode()]
        for source in self.facts.sources:
            parts += [source.encode(), _sum_of((self.folder or Path()) / source).encode()]
        for name, content in sorted(self.inputs.items()):
            parts += [name.encode(), content]
        return hashlib.sha256("".join(hashlib.sha256(part).hexdigest() for part in parts).encode()).hexdigest()


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
        kind = one_of(kinds.names(), table.get("kind"), "kind", "choose one.")
        made_by = kinds.kind(kind)
        common = ["schema", "kind", "title", "seed", "axis", "design", "list", "run"]
        check_keys(table, [*common, *made_by.KEYS], "")
        for key, value in table.items():
            # Some keys of kinds are words; all others are tables.
            if key not in (*common, "model", "initial", "stage") and not isinstance(value, dict):
                raise DataError(f"{key}: expected a table, found {shown(value)}; write [{key}] and its keys below.")
        seed = table.get("seed", 0)
        if isinstance(seed, bool) or not isinstance(seed, int) or seed < 0:
            raise DataError(f"seed: expected a whole number of 0 or more, found {shown(seed)}; correct it.")
        run = typed(table.get("run", {}), _Run, "run")
        job = made_by.make(Request(table, kept, folder))
        facts = job.facts
        plan = read_plan(table, facts.parameters, max(1, len(facts.sources)), seed, kept)
        if run.chunk_rows is not None and run.chunk_rows % facts.block:
            raise DataError(
                f"run.chunk_rows: expected a multiple of {facts.block}, as so many rows are computed together, found "
                f"{run.chunk_rows}; correct it, or leave it out."
            )
        return Sweep(text, name, inputs, kind, seed, plan, job, facts, run.memory_MB, run.chunk_rows, folder)
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
    for axis, parameter in sweep.swept:
        name, value, bounds, words = parameter.name, values[parameter.name], parameter, parameter.range_words
        if axis.relative:
            bounds, words = Parameter(name, "1", 1.0, lower=0.0), "0 to inf times its own"
        wrong = ~((value >= bounds.lower) & (value <= bounds.upper))
        kept[name] = np.where(wrong, bounds.nominal, value)
        for k in np.flatnonzero(wrong):
            reasons[k] = reasons[k] or f"{name} = {value[k]:.6g} lies outside its bounds, {words}"
    return kept, reasons
