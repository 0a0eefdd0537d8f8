"""What the commands share: the files they read and write, and what they tell meanwhile."""

import os
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from enum import StrEnum

import click

from fits.io._errors import DataError

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
        if sys.stderr is not None and sys.stderr.isatty():
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


def keep_apart(places: dict[str, str | None]) -> None:
    """Refuse to write where is read, or twice to one place."""
    seen: dict[str, str] = {}
    for option, place in places.items():
        if place is None:
            continue
        real = os.path.realpath(place)
        if real in seen:
            raise DataError(f"{option}: {place} would overwrite the file of {seen[real]}; choose another name.")
        seen[real] = option
