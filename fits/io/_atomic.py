"""Whole files or none: written under a temporary name in the same folder, then renamed."""

import csv
import gzip
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fits.io._errors import AnyPath, DataError
from fits.io._extras import need
from fits.io._file_set import file_set

# How names of the tables end that are written.
_TEXTS, _ARRAYS = ("", ".csv", ".txt", ".dat"), (".npz", ".parquet")
# Rows of a text that are made at a time.
_ROWS = 65_536


@contextmanager
def atomic_path(path: AnyPath) -> Iterator[Path]:
    """Yield a temporary path; on success it becomes `path`, on any exception it is deleted.

    It does not exist yet, lies in the same folder and ends as `path` does, so that Matplotlib infers the format. What
    is written is on the disk before it is at `path`; a symbolic link is followed. For the rest see `file_set`.
    """
    with file_set() as files:
        yield files.file(path)


def atomic_write_text(path: AnyPath, text: str) -> None:
    """Write text to `path` as UTF-8 with its line ends kept, whole or not at all; errors as `atomic_path`."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(text.encode())


def refuse_nonfinite(name: str, values: NDArray[Any]) -> None:
    """Refuse, in a `DataError`, to pass on results that are not finite, shape `(n,)`: no file holds any."""
    finite = np.isfinite(values) if values.dtype.kind in "fc" else np.ones(values.shape, dtype=bool)
    if not finite.all():
        row = int(np.argmin(finite))
        raise DataError(
            f"{name}: the result is {values[row]} from sample {row + 1} on, so nothing was written; check the "
            "numbers of the model and of the file it was given."
        )


def finite_json(content: Any) -> str:
    """Put results into JSON; a `DataError` says that one of them is not finite."""
    try:
        return json.dumps(content, indent=1, allow_nan=False)
    except ValueError:
        raise DataError(
            "a figure of the result is not finite; check the numbers of the files it was made from."
        ) from None


def write_csv(path: AnyPath, columns: Mapping[str, NDArray[Any]], comments: Sequence[str] = ()) -> None:
    """Write columns, shape `(n,)` each, as CSV that is read back exactly, with comments before the header.

    A name that ends in `.gz` is compressed. A `DataError` refuses values that are not finite.
    """
    arrays = [np.asarray(values) for values in columns.values()]
    for name, values in zip(columns, arrays, strict=True):
        refuse_nonfinite(name, values)
    with atomic_path(path) as temporary:
        opener: Any = gzip.open if temporary.suffix == ".gz" else open
        with opener(temporary, "wt", encoding="utf-8", newline="") as file:
            file.writelines(f"# {' '.join(comment.split())}\n" for comment in comments)
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(columns)
            for first in range(0, len(arrays[0]), _ROWS):
                lists = [values[first : first + _ROWS].tolist() for values in arrays]
                writer.writerows(zip(*lists, strict=True))  # csv writes floats by repr, which is exact


def check_table_name(path: AnyPath) -> None:
    """Refuse, in a `DataError`, a name that ends as that of a table which `write_table` does not write."""
    name = Path(path).name.lower()
    suffix = Path(name.removesuffix(".gz")).suffix
    if suffix not in (_TEXTS if name.endswith(".gz") else _TEXTS + _ARRAYS):
        raise DataError(
            f"{os.fspath(path)}: expected a name that ends in .csv, .csv.gz, .txt, .dat, .npz or .parquet, found one "
            "in another format; choose one of these."
        )


def write_table(path: AnyPath, columns: Mapping[str, NDArray[Any]]) -> None:
    """Write columns, shape `(n,)` each, in the format of the name: `.npz`, `.parquet`, or else CSV.

    A `DataError` refuses values that are not finite, and a format whose package is not installed.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in _ARRAYS:
        write_csv(path, columns)
        return
    for name, values in columns.items():
        refuse_nonfinite(name, np.asarray(values))
    with atomic_path(path) as temporary:
        if suffix == ".npz":
            np.savez(temporary, allow_pickle=False, **columns)
        else:
            need("pyarrow.parquet", "io").write_table(need("pyarrow", "io").table(dict(columns)), temporary)
