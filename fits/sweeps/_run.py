"""Running a sweep: what is missing is computed, kept chunk by chunk, and put into a table at the end."""

import os
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any

import numpy as np

from fits.io._atomic import atomic_path
from fits.io._jax_setup import require_float64
from fits.sweeps._spec import Sweep, chunk_count, compute_chunk, rows_of
from fits.sweeps._store import TABLE, Store, check_folder, need, opened
from fits.sweeps._types import FAILED


@dataclass(frozen=True)
class Outcome:
    """What a run did: rows of the whole sweep, those of them that failed, and those that this run computed.

    Chunks that were kept but broken were computed again; it took so many seconds.
    """

    rows: int
    failed: int
    computed: int
    again: int
    seconds: float


class _Progress:
    """Tells how far a sweep is, its rate, and the time that is left."""

    def __init__(self, progress: Callable[[str], None], rows: int, done: int):
        self._progress, self._rows, self._done, self._new = progress, rows, done, 0
        self._began = self._told = time.monotonic()

    def __call__(self, rows: int) -> None:
        self._done, self._new = self._done + rows, self._new + rows
        now = time.monotonic()
        if now - self._told >= 1 or self._done == self._rows:
            self._told = now
            rate = self._new / max(now - self._began, 1e-9)
            left = _duration((self._rows - self._done) / rate)
            bar = ("#" * (24 * self._done // self._rows)).ljust(24, ".")
            self._progress(f"[{bar}] {self._done:,} of {self._rows:,} rows, {rate:.3g} rows/s, {left} left")


def run_sweep(
    sweep: Sweep,
    out: str | os.PathLike[str],
    *,
    resume: bool = False,
    cluster: str | None = None,
    progress: Callable[[str], None] = lambda _: None,
) -> Outcome:
    """Run a sweep, or what is missing of it.

    `resume` goes on with the sweep that is in the folder `out`. The cluster is the address of a Dask scheduler, or
    `local:N` for N processes of this machine; None computes in this process. `progress` is told how far it is, a
    sentence at a time.

    A `DataError` says that the folder, the disk or the cluster does not allow it, a `RuntimeError` that JAX computes
    in single precision. Rows that fail do not raise: they are kept with the reason.
    """
    require_float64("sweeps need")
    began = time.monotonic()
    need("pyarrow")
    with ExitStack() as stack:
        client = None
        if cluster is not None:
            from fits.sweeps._cluster import connected

            # Before the folder is made, so that a mistake in the address leaves nothing behind.
            check_folder(sweep, os.fspath(out), resume)
            client = stack.enter_context(connected(cluster))
        store = stack.enter_context(opened(sweep, os.fspath(out), resume))
        chunks = range(chunk_count(sweep))
        done = {chunk for chunk in chunks if store.whole(chunk)} if resume else set()
        again = sum(store.entry(chunk).exists() for chunk in chunks if chunk not in done) if resume else 0
        if resume:
            progress(f"{len(done)} of {len(chunks)} chunks are there" + (f", {again} broken" if again else ""))
        left = [chunk for chunk in chunks if chunk not in done]
        tell = _Progress(progress, len(sweep.plan), sum(len(rows_of(sweep, chunk)) for chunk in done))
        if client is None:
            for chunk in left:
                store.write(chunk, compute_chunk(sweep, chunk, tell))
        else:
            from fits.sweeps._cluster import on_cluster

            for chunk, rows in on_cluster(client, sweep, left, progress):
                tell(len(rows.reasons))
                store.write(chunk, rows)
        progress("writing the table")
        failed = _table(store)
    new = sum(len(rows_of(sweep, chunk)) for chunk in left)
    return Outcome(len(sweep.plan), failed, new, again, time.monotonic() - began)


def _table(store: Store) -> int:
    """Write all rows but their traces as one Parquet file, chunk by chunk; the number of failed ones comes back."""
    arrow, parquet = need("pyarrow"), need("pyarrow.parquet")
    flat = [variable for variable in store.variables if not variable.dims]
    fields = [arrow.field("row", arrow.int64(), metadata={"unit": "1"})]
    for variable in flat:
        kind = arrow.string() if np.dtype(variable.dtype).kind == "U" else arrow.from_numpy_dtype(variable.dtype)
        fields.append(arrow.field(variable.name, kind, metadata={"unit": variable.unit}))
    schema = arrow.schema(fields, metadata={"sweep": store.sweep.text})
    failed = 0
    with atomic_path(store.folder / TABLE) as unfinished, parquet.ParquetWriter(unfinished, schema) as writer:
        for chunk in range(chunk_count(store.sweep)):
            arrays: dict[str, Any] = {"row": rows_of(store.sweep, chunk), **store.read(chunk)}
            failed += int(np.sum(arrays["status"] == FAILED))
            columns = [arrow.array(arrays[field.name], type=field.type) for field in fields]
            writer.write_table(arrow.Table.from_arrays(columns, schema=schema))
    return failed


def _duration(seconds: float) -> str:
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"
