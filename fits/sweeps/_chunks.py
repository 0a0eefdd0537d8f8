"""Rows in chunks that are computed and kept one at a time, and in blocks within them."""

from collections.abc import Callable

import jax
import numpy as np
from numpy.typing import NDArray

from fits.sweeps._spec import Sweep, outside
from fits.sweeps._types import DONE, FAILED, Block, Output, Rows

_REASON_LENGTH = 120
REASON = Output("reason", "1", "why the row failed", dtype=f"U{_REASON_LENGTH}")


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


def swept_of(sweep: Sweep) -> tuple[Output, ...]:
    """The variables that hold the values of the axes."""
    found = []
    for axis, parameter in sweep.swept:
        dtype = f"U{max(map(len, parameter.words))}" if parameter.words else "f8"
        found.append(Output(parameter.name, "1" if axis.relative else parameter.unit, "swept", dtype=dtype))
    return tuple(found)


def source_of(sweep: Sweep) -> Output:
    """The variable that says which source a row has, as wide as the longest name."""
    return Output("source", "1", "file of the row", dtype=f"U{max(map(len, sweep.facts.sources), default=1)}")


def chunk_count(sweep: Sweep) -> int:
    return -(-len(sweep.plan) // chunk_rows(sweep))


def rows_of(sweep: Sweep, chunk: int) -> NDArray[np.int64]:
    size = chunk_rows(sweep)
    return np.arange(chunk * size, min(len(sweep.plan), (chunk + 1) * size), dtype=np.int64)


def compute_chunk(sweep: Sweep, chunk: int, tell: Callable[[int], None] = lambda _: None) -> Rows:
    """Compute a chunk, its last blocks filled up; `tell` is called with the number of rows that is added."""
    rows, facts = rows_of(sweep, chunk), sweep.facts
    together = facts.block * (1 if facts.alone else jax.local_device_count())
    parts = []
    for first in range(0, len(rows), together):
        parts.append(_blocks(sweep, rows[first : first + together], together))
        tell(len(parts[-1].reasons))
    outputs = {name: np.concatenate([part.outputs[name] for part in parts]) for name in parts[0].outputs}
    return Rows(outputs, tuple(reason for part in parts for reason in part.reasons))


def _blocks(sweep: Sweep, rows: NDArray[np.int64], together: int) -> Rows:
    padded = np.pad(rows, (0, together - len(rows)), mode="edge")
    values = sweep.plan.values(padded)
    inside, refused = outside(sweep, values) if values else (values, [""] * len(padded))
    relative = tuple(axis.parameter for axis in sweep.plan.axes if axis.relative)
    found = sweep.job.compute(Block(inside, relative, padded, sweep.plan.repeat_of(padded), sweep.seed))
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
    outputs["status"] = np.where(failed, FAILED, DONE).astype("i1")
    return Rows(outputs, reasons)
