"""Places that a user names for results: what cannot be one is refused before the work."""

import os
import stat
from contextlib import suppress
from pathlib import Path

from fits.io._errors import DataError
from fits.io._temporary import remove_stale


def usable_folder(path: str | os.PathLike[str], option: str) -> tuple[Path, Path]:
    """Refuse a folder that cannot be written to, or made; itself and the nearest one that exists come back."""
    shown = os.fspath(path)
    if not shown:
        raise DataError(f"{option}: expected the name of a folder, found none; write . for the current one.")
    try:
        target = Path(os.path.realpath(path))
        anchor = next(place for place in (target, *target.parents) if os.path.lexists(place))
        # Also whether its name, and those on the way to it, can be.
        if target != anchor:
            _length_checked(target, anchor)
        good = anchor.is_dir() and os.access(anchor, os.W_OK | os.X_OK)
    except (OSError, ValueError) as error:
        raise DataError(
            f"{shown}: cannot be the name of a folder ({reason_of(error)}); choose another for {option}."
        ) from None
    if not good:
        raise DataError(f"{shown}: expected a folder that can be written to; choose another for {option}.")
    remove_stale(anchor)
    return target, anchor


def _length_checked(target: Path, anchor: Path) -> None:
    for name in target.relative_to(anchor).parts:
        with suppress(FileNotFoundError, NotADirectoryError):
            os.lstat(anchor / name)


def check_file(path: str | os.PathLike[str], shown: str | None = None) -> Path:
    """Refuse what cannot become, or be replaced by, a regular file; its real path comes back."""
    shown = os.fspath(path) if shown is None else shown
    if not shown:
        raise DataError("expected the name of a file to write, found an empty one; give one.")
    try:
        target = Path(os.path.realpath(path))
        mode = target.stat().st_mode
    except (FileNotFoundError, NotADirectoryError):
        mode = None
    except (OSError, ValueError) as error:
        raise DataError(f"{shown}: cannot be the name of a file ({reason_of(error)}); choose another.") from None
    if mode is not None and stat.S_ISDIR(mode):
        raise DataError(f"{shown}: expected the name of a file to write, found a folder; add a file name.")
    if mode is not None and not stat.S_ISREG(mode):
        # A rename would put a file in the place of what all other programs use.
        raise DataError(f"{shown}: expected a regular file or a new name, found a device or a pipe; choose another.")
    if not target.parent.is_dir():
        raise DataError(f"{shown}: the folder {target.parent} does not exist; create it or choose another.")
    if not os.access(target.parent, os.W_OK | os.X_OK):
        raise DataError(f"{shown}: the folder {target.parent} cannot be written to; choose another.")
    if mode is not None and not os.access(target, os.W_OK):
        raise DataError(f"{shown}: the file is write-protected; choose another name or allow writing.")
    return target


def reason_of(error: Exception) -> str:
    """Say why, as the system does."""
    return str(getattr(error, "strerror", None) or error)
