"""Where the rows of a sweep are kept: a Zarr store, and a ledger that says which chunks are whole.

A chunk goes into its own files of the store first and into the ledger, with the SHA-256 of its numbers, last. A
process that dies at any moment leaves a chunk either in the ledger or not done; one that is done again is written to
the same place with the same numbers. What the ledger says is checked against the numbers before a sweep goes on.
"""

import errno
import hashlib
import json
import os
import platform
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property, lru_cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, TypedDict

import msgspec
import numpy as np

from fits.io import _extras
from fits.io._atomic import atomic_write_text
from fits.io._errors import DataError
from fits.io._file_set import DISK_TROUBLE, flush, usable_folder
from fits.io._read_file import MOST_JSON_BYTES, parse_json, read_text
from fits.io._temporary import is_temporary
from fits.sweeps._spec import REASON, Sweep, bytes_per_row, chunk_count, chunk_rows, rows_of, source_of, swept_of
from fits.sweeps._types import STATUS_WORDS, Output, Rows

SCHEMA = "microid.sweep.results/1"
ABOUT, RESULTS, LEDGER, TEXT, TABLE = "about.json", "results.zarr", "ledger", "sweep.toml", "results.parquet"
_STATUS = Output("status", "1", "of the row: 0 pending, 1 done, 2 failed", dtype="i1")
# What the user can do something about: a full or a broken disk, permissions, and folders that are gone.
_TROUBLE = DISK_TROUBLE | {errno.EACCES, errno.EPERM, errno.ENOENT, errno.ENOTDIR}


class _About(TypedDict):
    """What `about.json` says of a sweep, beside what it has for the reader."""

    kind: str
    rows: int
    chunk_rows: int
    chunks: int
    parameters: list[str]
    outputs: list[str]
    digest: str
    versions: dict[str, str]


@dataclass(eq=False)
class Store:
    """The folder of one sweep, held by one process at a time."""

    sweep: Sweep
    folder: Path

    @property
    def variables(self) -> tuple[Output, ...]:
        """Everything that is kept per row."""
        sources = (source_of(self.sweep),) if self.sweep.facts.sources else ()
        return (*swept_of(self.sweep), *sources, *self.sweep.facts.outputs, _STATUS, REASON)

    def create(self) -> None:
        """Write the empty store and what is known of the sweep."""
        zarr, sweep = need("zarr"), self.sweep
        rows, size, names = len(sweep.plan), chunk_rows(sweep), [axis.parameter for axis in sweep.plan.axes]
        about = {
            "schema": SCHEMA,
            "kind": sweep.kind,
            "rows": rows,
            "chunk_rows": size,
            "chunks": chunk_count(sweep),
            "seed": sweep.seed,
            "parameters": names,
            "relative": [axis.parameter for axis in sweep.plan.axes if axis.relative],
            "outputs": [output.name for output in sweep.facts.outputs],
            "digest": sweep.digest,
            "versions": versions(),
            "sweep": sweep.text,
        }
        with _sentences(self.folder):
            (self.folder / LEDGER).mkdir(parents=True, exist_ok=True)
            group = zarr.open_group(str(self.folder / RESULTS), mode="w", zarr_format=2)
            for variable in self.variables:
                array = group.create_array(
                    variable.name,
                    shape=(rows, *variable.shape),
                    chunks=(size, *variable.shape),
                    dtype=variable.dtype,
                    # Without one xarray leaves whole numbers and texts as they are.
                    fill_value=float("nan") if np.dtype(variable.dtype).kind == "f" else None,
                )
                attributes: dict[str, Any] = {"units": variable.unit, "long_name": variable.meaning}
                if variable is _STATUS:
                    attributes |= {"flag_values": [0, 1, 2], "flag_meanings": " ".join(STATUS_WORDS)}
                array.attrs.update(attributes | {"_ARRAY_DIMENSIONS": ["row", *(name for name, _ in variable.dims)]})
            for name, (axis, unit, values) in sweep.facts.coordinates.items():
                array = group.create_array(name, shape=values.shape, chunks=values.shape, dtype=values.dtype)
                array[:] = values
                array.attrs.update({"units": unit, "_ARRAY_DIMENSIONS": [axis]})
            group.attrs.update(about | ({"coordinates": " ".join(names)} if names else {}))
            zarr.consolidate_metadata(group.store)
            atomic_write_text(self.folder / TEXT, sweep.text)
            # Last: a folder without it holds no sweep yet.
            atomic_write_text(self.folder / ABOUT, json.dumps(about, indent=1) + "\n")

    @cached_property
    def _group(self) -> Any:
        return need("zarr").open_group(str(self.folder / RESULTS), mode="r+", zarr_format=2)

    def entry(self, chunk: int) -> Path:
        """The file by which a chunk is in the ledger."""
        return self.folder / LEDGER / f"{chunk:08d}.json"

    def sound(self) -> bool:
        """Whether the store is there, with all variables as they should be."""
        rows, size = len(self.sweep.plan), chunk_rows(self.sweep)
        try:
            json.loads((self.folder / RESULTS / ".zmetadata").read_text(encoding="utf-8"))
            for variable in self.variables:
                array, shape = self._group[variable.name], variable.shape
                expected = (rows, *shape), (size, *shape), np.dtype(variable.dtype)
                if (array.shape, array.chunks, array.dtype) != expected:
                    return False
            return (self.folder / LEDGER).is_dir()
        except Exception:
            # Whatever a broken file makes a decoder say, the store is not sound.
            return False

    def clear(self) -> None:
        """Delete what processes that were killed have left of files; the lock says that no other is at work."""
        left = [path for folder in (self.folder, self.folder / LEDGER) for path in folder.glob(".*")]
        left = [path for path in left if is_temporary(path.name)]
        # What zarr calls a file before it is whole.
        for path in (*left, *(self.folder / RESULTS).glob("**/*.partial")):
            path.unlink(missing_ok=True)

    def write(self, chunk: int, rows: Rows) -> None:
        """Keep a chunk, then say so in the ledger; a `DataError` says that the disk does not take it."""
        arrays = dict(rows.outputs) | {"reason": np.array(rows.reasons, dtype=REASON.dtype)}
        with _sentences(self.folder):
            start = chunk * chunk_rows(self.sweep)
            for variable in self.variables:
                array = np.ascontiguousarray(arrays[variable.name], dtype=variable.dtype)
                self._group[variable.name][start : start + len(array)] = array
                path = self.folder / RESULTS / variable.name / f"{chunk}{'.0' * len(variable.shape)}"
                # A chunk of nothing but fill values has no file; others are on the disk before the ledger says so.
                if path.exists():
                    flush(path)
            entry = {"sha256": self._sum(arrays), "failed": sum(map(bool, rows.reasons)), "rows": len(rows.reasons)}
            atomic_write_text(self.entry(chunk), json.dumps(entry) + "\n")

    def read(self, chunk: int) -> dict[str, np.ndarray]:
        rows, group = rows_of(self.sweep, chunk), self._group
        place = slice(int(rows[0]), int(rows[-1]) + 1)
        return {variable.name: np.asarray(group[variable.name][place]) for variable in self.variables}

    def whole(self, chunk: int) -> bool:
        """Whether a chunk is in the ledger and what is kept of it has the sum that is written there."""
        try:
            entry = json.loads(self.entry(chunk).read_text(encoding="utf-8"))
            return bool(entry["sha256"] == self._sum(self.read(chunk)))
        except Exception:
            # Whatever a broken file makes a decoder say, the chunk is not whole.
            return False

    def _sum(self, arrays: dict[str, np.ndarray]) -> str:
        total = hashlib.sha256()
        for variable in self.variables:
            total.update(np.ascontiguousarray(arrays[variable.name], dtype=variable.dtype).tobytes())
        return total.hexdigest()


def about_of(folder: str | os.PathLike[str]) -> dict[str, Any]:
    """Read what is known of a sweep; a `DataError` says why it cannot be read."""
    if not (Path(folder) / ABOUT).exists():
        raise DataError(f"{folder}: there is no sweep in this folder; give the one of its results.")
    try:
        what = "what is known of a sweep"
        about: Any = parse_json(read_text(Path(folder) / ABOUT, what, MOST_JSON_BYTES), ABOUT, what)
        if isinstance(about, dict) and about.get("schema") == SCHEMA:
            msgspec.convert(about, _About)
            return about
        fault = f"expected results of the format {SCHEMA}"
    except (DataError, msgspec.ValidationError) as error:
        fault = f"{ABOUT} is broken ({error})"
    raise DataError(f"{folder}: {fault}; run the sweep again in another folder.")


def check_folder(sweep: Sweep, out: str, resume: bool) -> None:
    """Refuse a folder that cannot be written to, or holds something else, before anything starts; see `opened`."""
    need("zarr")
    folder, anchor = usable_folder(out)
    if (folder / ABOUT).exists():
        if not resume:
            raise DataError(f"{out}: there is a sweep in this folder; resume it to go on, or choose another folder.")
        about = about_of(out)
        for name, version in versions().items():
            before = about["versions"].get(name)
            if before != version:
                raise DataError(
                    f"{out}: the sweep was begun with {name} {before}, and this is {version}; go on with that "
                    "version, or begin anew in another folder."
                )
        if about["digest"] != sweep.digest or about["chunk_rows"] != chunk_rows(sweep):
            raise DataError(
                f"{out}: the folder holds the results of another sweep or other files; give the one that is in its "
                f"{TEXT}, or choose another folder."
            )
        return
    own = (RESULTS, LEDGER, TEXT, ".lock")
    if folder.exists() and any(path.name not in own and not is_temporary(path.name) for path in folder.iterdir()):
        raise DataError(f"{out}: the folder holds other files; choose another.")
    # The table holds all but the traces once more, and a disk that is nearly full is full for others.
    needed = len(sweep.plan) * 2 * bytes_per_row(sweep)
    free = shutil.disk_usage(anchor).free
    if needed > 0.9 * free:
        raise DataError(
            f"{out}: {len(sweep.plan):,} rows would take about {needed / 1e9:.3g} GB, and the disk has "
            f"{free / 1e9:.3g} GB; keep fewer rows or no traces, or choose another disk."
        )


@contextmanager
def opened(sweep: Sweep, out: str, resume: bool) -> Iterator[Store]:
    """Open the folder of a sweep, new or to go on with, and keep others out; refusals are those of `check_folder`."""
    check_folder(sweep, out, resume)
    folder = Path(os.path.realpath(out))
    begun = (folder / ABOUT).exists()
    with _sentences(folder):
        folder.mkdir(parents=True, exist_ok=True)
    with _locked(folder, out):
        if (folder / ABOUT).exists() != begun:
            # Another process has begun it meanwhile.
            check_folder(sweep, out, resume)
        store = Store(sweep, folder)
        with _sentences(folder):
            store.clear()
        if not ((folder / ABOUT).exists() and store.sound()):
            store = Store(sweep, folder)
            store.create()
        yield store


@contextmanager
def _locked(folder: Path, out: str) -> Iterator[None]:
    """Keep a second process out; the lock goes with the process that holds it."""
    try:
        import fcntl
    except ImportError:  # Windows: nothing keeps a second process out.
        yield
        return
    with open(folder / ".lock", "w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise DataError(f"{out}: another process works on this sweep; wait for it, or stop it first.") from None
        yield


@contextmanager
def _sentences(folder: Path) -> Iterator[None]:
    """Turn an OSError of the disk into a `DataError`."""
    try:
        yield
    except OSError as error:
        if error.errno not in _TROUBLE:
            raise
        raise DataError(
            f"{folder}: cannot be written ({error.strerror or error}); what was done before is kept: free the disk "
            "or correct the permissions, then resume the sweep."
        ) from error


def need(name: str) -> Any:
    """Import a package of the extras `sweep` and `cluster`; a `DataError` says what to run if it is not installed."""
    return _extras.need(name, "sweep,cluster" if name.partition(".")[0] == "distributed" else "sweep")


@lru_cache(maxsize=1)
def versions() -> dict[str, str]:
    """Version of Python and of each package that computes."""
    found = {"python": platform.python_version()}
    for name in ("microid", "jax", "jaxlib", "equinox", "optimistix", "numpy", "scipy"):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = _checkout() if name == "microid" else "not installed"
    return found


def _checkout() -> str:
    """What tells a checkout that is not installed from others: a sum of its sources."""
    total, root = hashlib.sha256(), Path(__file__).parents[2]
    for path in sorted(path for package in ("fits", "microid") for path in (root / package).rglob("*.py")):
        total.update(path.relative_to(root).as_posix().encode() + path.read_bytes())
    return f"checkout {total.hexdigest()[:12]}"
