"""What the commands share: the files they read and write, and what they tell meanwhile."""

import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from enum import StrEnum
from pathlib import Path

import click

from fits._errors import DataError

_DEFAULT_HOLDOUT = 0.2


def progress_to_stderr(quiet: bool) -> Callable[[str], None]:
    """Make what tells on stderr what is being done, and since when."""
    began = time.monotonic()

    def tell(sentence: str) -> None:
        if not quiet:
            click.echo(f"{time.monotonic() - began:6.1f} s  {sentence}", err=True)

    return tell


def bar_to_stderr(quiet: bool, stages: Sequence[StrEnum]) -> Callable[[str], None]:
    """Make what draws on stderr how far the work has come, a step for each stage that is announced.

    A stage is announced by itself; other sentences tell of details. On a terminal the bar stays in its line;
    elsewhere each sentence has its own.
    """
    began, at = time.monotonic(), 0

    def tell(sentence: str) -> None:
        nonlocal at
        if quiet:
            return
        if isinstance(sentence, StrEnum):
            at = max(at, stages.index(sentence) + 1)
        bar = "#" * at + "." * (len(stages) - at)
        line = f"[{bar}] {time.monotonic() - began:6.1f} s  {sentence}"
        if sys.stderr.isatty():
            click.echo(f"\r\033[K{line}", nl=at == len(stages), err=True)
        else:
            click.echo(line, err=True)

    return tell


def fraction_or_files(given: Sequence[str]) -> tuple[float, list[str]]:
    """Tell a fraction from files."""
    numbers = []
    for text in given:
        try:
            numbers.append(float(text))
        except ValueError:
            continue
    if not given:
        return _DEFAULT_HOLDOUT, []
    if not numbers:
        return 0.0, list(given)
    if len(given) > 1:
        raise DataError("--holdout: expected one fraction, or files only, found a fraction with others; choose one.")
    if not 0 <= numbers[0] <= 0.9:
        raise DataError(f"--holdout: expected a fraction between 0 and 0.9 or a file, found {given[0]}.")
    return numbers[0], []


def keep_inputs(out: str, inputs: Iterable[str]) -> None:
    """Refuse to overwrite what is read."""
    for path in inputs:
        if os.path.realpath(path) == os.path.realpath(out):
            raise DataError(f"--out: {out} would overwrite what is read; choose another name.")


@contextmanager
def new_folder(path: str | None, option: str = "--plots", what: str = "plots") -> Iterator[Callable[[], Path] | None]:
    """Yield a function that makes a temporary folder; what is in it moves to `path` at the end, or nowhere."""
    if path is None:
        yield None
        return
    target = Path(os.path.realpath(path))
    anchor = next(place for place in (target, *target.parents) if place.exists())
    if not anchor.is_dir() or not os.access(anchor, os.W_OK | os.X_OK):
        raise DataError(f"{path}: expected a folder that can be written to; choose another for {option}.")
    made: list[Path] = []

    def refused(error: OSError) -> DataError:
        reason = error.strerror or error
        return DataError(f"{path}: the {what} cannot be put there ({reason}); choose another for {option}.")

    with ExitStack() as stack:

        def make() -> Path:
            try:
                place = stack.enter_context(tempfile.TemporaryDirectory(dir=anchor, prefix=".microid-"))
            except OSError as error:
                raise refused(error) from error
            made.append(Path(place))
            return made[-1]

        yield make
        try:
            target.mkdir(parents=True, exist_ok=True)
            for file in sorted(file for folder in made for file in folder.iterdir()):
                os.replace(file, target / file.name)
        except OSError as error:
            raise refused(error) from error
