"""Whole files or none: written under a temporary name in the same folder, then renamed."""

import csv
import errno
import gzip
import json
import os
import secrets
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fits._errors import DataError

_DISK_TROUBLE = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EIO}


@contextmanager
def atomic_path(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a temporary path; on success it becomes `path`, on any exception it is deleted.

    The temporary path does not exist yet, lies in the same folder and ends as `path` does, so that Matplotlib
    infers the format. A file that was at `path` before is replaced in one step or left as it was.

    Parameters
    ----------
    path
        File to write. A symbolic link is followed.

    Raises
    ------
    DataError
        The folder is missing or cannot be written to, `path` is a folder or write-protected, or the disk is full.
    """
    target = Path(os.path.realpath(path))
    _check_writable(path, target)
    temporary = target.with_name(f".{secrets.token_hex(8)}-{target.name[-50:]}")
    try:
        yield temporary
        os.replace(temporary, target)
    except OSError as error:
        # Errors of other files that the caller reads meanwhile are not ours to explain.
        if error.filename != str(temporary) and error.errno not in _DISK_TROUBLE:
            raise
        raise DataError(
            f"{os.fspath(path)}: cannot be written ({error.strerror or error}); "
            "free the disk, close the file in other programs or choose another place."
        ) from error
    finally:
        temporary.unlink(missing_ok=True)


def _check_writable(path: str | os.PathLike[str], target: Path) -> None:
    shown = os.fspath(path)
    if target.is_dir():
        raise DataError(f"{shown}: expected the name of a file to write, found a folder; add a file name.")
    if not target.parent.is_dir():
        raise DataError(f"{shown}: the folder {target.parent} does not exist; create it or choose another.")
    if not os.access(target.parent, os.W_OK | os.X_OK):
        raise DataError(f"{shown}: the folder {target.parent} cannot be written to; choose another.")
    if target.exists() and not os.access(target, os.W_OK):
        raise DataError(f"{shown}: the file is write-protected; choose another name or allow writing.")


def atomic_write_bytes(path: str | os.PathLike[str], data: bytes) -> None:
    """Write bytes to `path`, whole or not at all; errors are those of `atomic_path`."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)


def atomic_write_text(path: str | os.PathLike[str], text: str) -> None:
    """Write text to `path` as UTF-8 with its line ends kept, whole or not at all; errors as `atomic_path`."""
    atomic_write_bytes(path, text.encode())


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


def write_csv(path: str | os.PathLike[str], columns: Mapping[str, NDArray[Any]]) -> None:
    """Write columns as CSV, with as many digits as reading them back exactly takes.

    Parameters
    ----------
    path
        File to write; a name that ends in ``.gz`` is compressed.
    columns
        Header to values, each of shape (n,).

    Raises
    ------
    ValueError
        The columns differ in length.
    DataError
        As `atomic_path`, or a value is not finite.
    """
    for name, values in columns.items():
        refuse_nonfinite(name, np.asarray(values))
    lists = [np.asarray(values).tolist() for values in columns.values()]
    with atomic_path(path) as temporary:
        opener: Any = gzip.open if temporary.suffix == ".gz" else open
        with opener(temporary, "wt", encoding="utf-8", newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(columns)
            writer.writerows(zip(*lists, strict=True))  # csv writes floats by repr, which is exact
