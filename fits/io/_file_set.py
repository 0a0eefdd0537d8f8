"""Files that appear together, or not at all: all are written under temporary names, then all are renamed."""

import errno
import logging
import os
import shutil
import stat
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import overload

from fits.io._errors import AnyPath, DataError, reason_of
from fits.io._temporary import is_temporary, remove_stale, temporary_name

_LOG = logging.getLogger(__name__)
DISK_TROUBLE = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EIO}


def usable_folder(path: AnyPath) -> tuple[Path, Path]:
    """Refuse a folder that cannot be written to, or made; itself and the nearest one that exists come back."""
    shown = os.fspath(path)
    if not shown:
        raise DataError("expected the name of a folder, found an empty one; write . for the current one.")
    try:
        target = Path(os.path.realpath(path))
        anchor = next(place for place in (target, *target.parents) if os.path.lexists(place))
        # Also whether its name, and those on the way to it, can be.
        for name in target.relative_to(anchor).parts:
            with suppress(FileNotFoundError, NotADirectoryError):
                os.lstat(anchor / name)
        wrong = _unwritable(anchor)
    except (OSError, ValueError) as error:
        raise DataError(f"{shown}: cannot be the name of a folder ({reason_of(error)}); choose another.") from None
    if wrong:
        raise DataError(f"{shown}: expected a folder that can be written to ({wrong}); choose another.")
    remove_stale(anchor)
    return target, anchor


def _unwritable(folder: Path) -> str:
    """Why nothing can be made in a folder, by trying, or nothing: rights alone do not tell of what is mounted."""
    trial = folder / temporary_name()
    try:
        try:
            trial.mkdir()
            trial.rmdir()
        finally:
            # A request to end may come between the two; one that comes here finds nothing to remove.
            if trial.exists():
                trial.rmdir()
    except OSError as error:
        return reason_of(error)
    return ""


def check_file(path: AnyPath, shown: str | None = None) -> Path:
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
    if wrong := _unwritable(target.parent):
        raise DataError(f"{shown}: the folder {target.parent} cannot be written to ({wrong}); choose another.")
    if mode is not None and not os.access(target, os.W_OK):
        raise DataError(f"{shown}: the file is write-protected; choose another name or allow writing.")
    return target


@dataclass(frozen=True)
class _Move:
    """What is at `staged` goes to `target`; None deletes what is there. `shown` is its name in sentences."""

    staged: Path | None
    target: Path
    shown: str

    def refused(self, error: OSError) -> DataError:
        """Say that the file cannot be written."""
        return DataError(
            f"{self.shown}: cannot be written ({reason_of(error)}); "
            "free the disk, close the file in other programs or choose another place."
        )


@dataclass(frozen=True)
class _Folder:
    """A folder to be: `staged` is the temporary one, and becomes `first`, the first that is missing on the way."""

    staged: Path
    first: Path
    files: Path
    target: Path
    shown: str

    def refused(self, error: OSError) -> DataError:
        """Say that nothing can be put there."""
        return DataError(f"{self.shown}: files cannot be put there ({reason_of(error)}); choose another.")


class FileSet:
    """Files that appear together at the end of `file_set`."""

    def __init__(self) -> None:
        self._files: list[_Move] = []
        self._folders: list[_Folder] = []
        self._scraps: list[Path] = []

    def file(self, path: AnyPath) -> Path:
        """Give a temporary name, of the ending of `path`, for a file to write; a `DataError` if `path` cannot be."""
        target = check_file(path)
        if any(is_temporary(part) for part in target.parts):
            # Of another set, which puts it in its place or deletes it.
            return target
        _refuse_twice(target, os.fspath(path), self._all())
        remove_stale(target.parent)
        staged = target.with_name(temporary_name(target.suffix))
        self._files.append(_Move(staged, target, os.fspath(path)))
        return staged

    def absent(self, path: AnyPath) -> None:
        """Have no file at `path` in the end; a missing one is fine."""
        self._files.append(_Move(None, Path(os.path.realpath(path)), os.fspath(path)))

    @overload
    def folder(self, path: AnyPath) -> Path: ...
    @overload
    def folder(self, path: AnyPath | None) -> Path | None: ...
    def folder(self, path: AnyPath | None) -> Path | None:
        """Make a temporary folder, whose files go to the folder `path`; for None there is none.

        A `DataError` says that `path`, which is made if need be, cannot be written to, or is no folder.
        """
        if path is None:
            return None
        target, anchor = usable_folder(path)
        missing = target.relative_to(anchor).parts
        staged = anchor / temporary_name()
        files = staged.joinpath(*missing[1:])
        folder = _Folder(staged, anchor.joinpath(*missing[:1]), files, target, os.fspath(path))
        _refuse_twice(target, folder.shown, self._all())
        # Known before it is there, so that an interruption at any moment finds it.
        self._folders.append(folder)
        with _explained(folder):
            files.mkdir(parents=True)
        return files

    def _all(self) -> list[_Move | _Folder]:
        return [*self._files, *self._folders]

    def commit(self) -> None:
        """Put all files in their places, or none."""
        moves = self._from_folders()
        moves += [move for move in self._files if move.staged is not None or os.path.lexists(move.target)]
        for k, move in enumerate(moves):
            _refuse_twice(move.target, move.shown, moves[:k])
            if move.staged is None or not move.staged.is_dir():
                check_file(move.target, move.shown)
        for move in moves:
            if move.staged is not None and not move.staged.is_dir():
                flush(move.staged)
        with ExitStack() as undo:
            for move in moves:
                # A single one has happened or not. Of several the last is undone too: it may just have happened when
                # an interruption comes.
                if len(moves) > 1:
                    undo.callback(self._undoing(move))
                with _explained(move):
                    if move.staged is None:
                        move.target.unlink(missing_ok=True)
                    else:
                        os.replace(move.staged, move.target)
            undo.pop_all()
        for move in moves:
            _LOG.debug("%s %s", "removed" if move.staged is None else "wrote", move.shown)
        for path in {move.target.parent for move in moves}:
            # Not all systems can; and what is renamed stays renamed.
            with suppress(OSError):
                folder = os.open(path, os.O_RDONLY)
                try:
                    os.fsync(folder)
                finally:
                    os.close(folder)

    def _from_folders(self) -> list[_Move]:
        moves = []
        for folder in self._folders:
            with _explained(folder):
                files = sorted(folder.files.iterdir())
                if not os.path.lexists(folder.first):
                    for file in files:
                        flush(file)
                    # All of it in one step.
                    moves.append(_Move(folder.staged, folder.first, folder.shown))
                    continue
                folder.target.mkdir(parents=True, exist_ok=True)
            for file in files:
                real = Path(os.path.realpath(folder.target / file.name))
                moves.append(_Move(file, real, str(Path(folder.shown) / file.name)))
        return moves

    def _undoing(self, move: _Move) -> Callable[[], None]:
        """Make what undoes a move, whether or not it has been made."""
        kept = move.target.with_name(temporary_name()) if move.target.exists() else None
        if kept is not None:
            self._scraps.append(kept)
            with _explained(move):
                try:
                    # A second name: at no moment there is no file under the first.
                    os.link(move.target, kept)
                except OSError:
                    shutil.copy2(move.target, kept)

        def undo() -> None:
            if kept is not None:
                if kept.exists():
                    os.replace(kept, move.target)
            elif move.staged is not None and not move.staged.exists():
                os.rename(move.target, move.staged)

        return undo

    def discard(self) -> None:
        """Delete all that is left under temporary names."""
        for path in [*self._scraps, *(move.staged for move in self._files if move.staged)]:
            with suppress(OSError):
                path.unlink(missing_ok=True)
        for folder in self._folders:
            shutil.rmtree(folder.staged, ignore_errors=True)

    def explain(self, error: OSError) -> DataError | None:
        """Put what the system says of these files into a sentence; errors of others are not ours to explain."""
        name = os.fspath(error.filename) if isinstance(error.filename, str | os.PathLike) else ""
        for each in self._all():
            if f"{name}{os.sep}".startswith(f"{each.staged}{os.sep}"):
                return each.refused(error)
        if error.errno in DISK_TROUBLE and self._all():
            first = self._all()[0]
            return _Move(None, first.target, first.shown).refused(error)
        return None


# Those that are in use.
_OPEN: list[FileSet] = []


@contextmanager
def file_set() -> Iterator[FileSet]:
    """Collect files that appear together at the end, or, on any exception, not at all.

    All are written to the disk before the first is renamed. If a rename fails, those before it are undone. A process
    that is killed meanwhile leaves each file as it was or whole, and temporary ones that the next `file_set` in the
    same folder removes; a folder that was not there appears in one step with all that is in it. A `DataError` says
    that a file cannot be written, or that the disk is full. Commands enter it before their work, so that a place that
    cannot be written to is refused before the wait.
    """
    files = FileSet()
    _OPEN.append(files)
    try:
        yield files
        files.commit()
    except OSError as error:
        explained = files.explain(error)
        if explained is None:
            raise
        raise explained from error
    finally:
        files.discard()
        _OPEN.remove(files)


def discard_all() -> None:
    """Delete what is under temporary names, for a process that ends: a signal may come at any moment."""
    for files in _OPEN:
        files.discard()


def _refuse_twice(target: Path, shown: str, others: Iterable[_Move | _Folder]) -> None:
    if any(target == each.target for each in others):
        raise DataError(f"{shown}: two results would go to this place; choose another for one of them.")


def flush(path: Path) -> None:
    """Have a file on the disk before it gets its name; an OSError says that the disk is full after all."""
    with open(path, "r+b") as file:
        try:
            os.fsync(file.fileno())
        except OSError as error:
            # Some file systems have no such thing as flushing.
            if error.errno not in (errno.EINVAL, errno.ENOTSUP, errno.ENOSYS):
                raise OSError(error.errno, error.strerror, str(path)) from error


@contextmanager
def _explained(place: _Move | _Folder) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise place.refused(error) from error
