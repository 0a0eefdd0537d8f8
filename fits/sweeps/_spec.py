"""A sweep as a TOML file describes it, checked before anything runs, and its rows in chunks and blocks."""

import hashlib
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import jax
import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from fits.io._errors import DataError, shown
from fits.io._read_file import MOST_CSV_BYTES, MOST_TOML_BYTES, parse_toml, read_bytes, read_text
from fits.io._typed import check_keys, typed
from fits.sweeps import _types as t
from fits.sweeps import kinds
from fits.sweeps._axes import Axis, Plan
from fits.sweeps._read_axes import read_plan

_MOST_MB = 1_000_000_000
_REASON_LENGTH = 120
REASON = t.Output("reason", "1", "why the row failed", dtype=f"U{_REASON_LENGTH}")


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
    job: t.AbstractJob
    facts: t.Facts
    memory_MB: float
    chunk_rows: int | None
    folder: Path | None = None

    @property
    def swept(self) -> list[tuple[Axis, t.Parameter]]:
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
        if table.get("schema") != t.SCHEMA:
            raise DataError(f'schema: expected "{t.SCHEMA}", found {shown(table.get("schema"))}; give that.')
        kind = t.one_of(kinds.names(), table.get("kind"), "kind", "choose one.")
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
        job = made_by.make(t.Request(table, kept, folder))
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
            bounds, words = t.Parameter(name, "1", 1.0, lower=0.0), "0 to inf times its own"
        wrong = ~((value >= bounds.lower) & (value <= bounds.upper))
        kept[name] = np.where(wrong, bounds.nominal, value)
        for k in np.flatnonzero(wrong):
            reasons[k] = reasons[k] or f"{name} = {value[k]:.6g} lies outside its bounds, {words}"
    return kept, reasons


_REASON_LENGTH = 120
REASON = t.Output("reason", "1", "why the row failed", dtype=f"U{_REASON_LENGTH}")


def chunk_rows(sweep: Sweep) -> int:
    """Rows of a chunk: whole blocks, as many as the memory and the codec allow."""
    block, rows = sweep.facts.block, len(sweep.plan)
    widest = max(output.bytes_per_row for output in (*sweep.facts.outputs, REASON))
    # No codec takes more of one variable at once than 2 GB.
    most = max(1, min(-(-rows // block), 2_000_000_000 // (widest * block)))
    if sweep.chunk_rows is not None:
        return min(sweep.chunk_rows, block * most)
    fit = int(sweep.memory_MB * 1e6 / (bytes_per_row(sweep) + REASON.bytes_per_row))
    # A sixteenth of all rows, so that there is progress to see and little to do again, and not too large. Rows that
    # go one by one are slow ones, of which few are to be lost.
    wanted = min(fit, most * block, 65536 if block > 1 else 4, max(1, rows // 16))
    return block * max(1, min(wanted, rows) // block)


def bytes_per_row(sweep: Sweep) -> int:
    """What a row takes before compression, without the reason, of which compression leaves next to nothing."""
    return sum(output.bytes_per_row for output in (*swept_of(sweep), *sweep.facts.outputs)) + 1


def swept_of(sweep: Sweep) -> tuple[t.Output, ...]:
    """The variables that hold the values of the axes."""
    found = []
    for axis, parameter in sweep.swept:
        dtype = f"U{max(map(len, parameter.words))}" if parameter.words else "f8"
        found.append(t.Output(parameter.name, "1" if axis.relative else parameter.unit, "swept", dtype=dtype))
    return tuple(found)


def source_of(sweep: Sweep) -> t.Output:
    """The variable that says which source a row has, as wide as the longest name."""
    return t.Output("source", "1", "file of the row", dtype=f"U{max(map(len, sweep.facts.sources), default=1)}")


def chunk_count(sweep: Sweep) -> int:
    return -(-len(sweep.plan) // chunk_rows(sweep))


def rows_of(sweep: Sweep, chunk: int) -> NDArray[np.int64]:
    size = chunk_rows(sweep)
    return np.arange(chunk * size, min(len(sweep.plan), (chunk + 1) * size), dtype=np.int64)


def compute_chunk(sweep: Sweep, chunk: int, tell: Callable[[int], None] = lambda _: None) -> t.Rows:
    """Compute a chunk, its last blocks filled up; `tell` is called with the number of rows that is added."""
    rows, facts = rows_of(sweep, chunk), sweep.facts
    together = facts.block * (1 if facts.alone else jax.local_device_count())
    parts = []
    for first in range(0, len(rows), together):
        parts.append(_blocks(sweep, rows[first : first + together], together))
        tell(len(parts[-1].reasons))
    outputs = {name: np.concatenate([part.outputs[name] for part in parts]) for name in parts[0].outputs}
    return t.Rows(outputs, tuple(reason for part in parts for reason in part.reasons))


def _blocks(sweep: Sweep, rows: NDArray[np.int64], together: int) -> t.Rows:
    padded = np.pad(rows, (0, together - len(rows)), mode="edge")
    values = sweep.plan.values(padded)
    inside, refused = outside(sweep, values) if values else (values, [""] * len(padded))
    relative = tuple(axis.parameter for axis in sweep.plan.axes if axis.relative)
    found = sweep.job.compute(t.Block(inside, relative, padded, sweep.plan.repeat_of(padded), sweep.seed))
    both = zip(refused, found.reasons, strict=True)
    reasons = tuple((why or reason)[:_REASON_LENGTH] for why, reason in both)[: len(rows)]
    failed = np.array([bool(reason) for reason in reasons])
    outputs: dict[str, NDArray[np.generic]] = {}
    for output in sweep.facts.outputs:
        outputs[output.name] = np.asarray(found.outputs[output.name])[: len(rows)].astype(output.dtype)
        if outputs[output.name].dtype.kind == "f":
            outputs[output.name][failed] = np.nan
    for _, parameter in sweep.swept:
        words, value = np.array(parameter.words), values[parameter.name][: len(rows)]
        outputs[parameter.name] = words[value.astype(int)] if len(words) else value
    if sweep.facts.sources:
        names = [sweep.facts.sources[k] for k in sweep.plan.repeat_of(rows)]
        outputs["source"] = np.array(names, dtype=source_of(sweep).dtype)
    outputs["status"] = np.where(failed, t.FAILED, t.DONE).astype("i1")
    return t.Rows(outputs, reasons)
