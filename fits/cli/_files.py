"""What the commands share: the places that they read and write, and what they tell."""

import os
import re
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from enum import StrEnum
from pathlib import Path
from typing import Any

import click

from fits.cli._common import Given
from fits.io._errors import DataError

_DEFAULT_HOLDOUT = 0.2
_LENGTH = re.compile(r"\s*([0-9.eE+-]+)\s*([a-zµμ]+)\s*")


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


def print_result(given: Given, content: Any, lines: Iterable[str]) -> None:
    """Print a result: as JSON where that is asked for, else in lines."""
    from fits.io._atomic import finite_json

    click.echo(finite_json(content) if given.as_json else "\n".join(lines))


def paths_in(folder: str | None, made: Iterable[str | Path]) -> list[str]:
    """Names of the files that were made for a folder, as the user named it."""
    return [str(Path(folder or "") / Path(file).name) for file in made]


def with_paths(words: str, places: Iterable[tuple[str, str | None]]) -> str:
    """Words, then what was written where; what was not has no place."""
    written = [f"{what:5}  {place}" for what, place in places if place is not None]
    return "\n".join([words, *([""] if written else []), *written])


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


def length_mm(option: str, text: str, units: Sequence[str], example: str) -> float:
    """Read a length with one of some units, such as `0.02mm`, in mm."""
    from fits.io._quantity import Quantity

    length = Quantity("length", "mm", {"mm": 0, "um": -3, "µm": -3, "μm": -3, "m": 3})
    found = _LENGTH.fullmatch(text)
    try:
        number = float(found[1]) if found and found[2] in units else 0.0
    except ValueError:
        number = 0.0
    if not (found and 0 < number < float("inf")):
        raise DataError(
            f"{option}: expected a length above 0 with its unit, found '{text}'; write one such as {example}."
        )
    return float(length.convert(number, found[2]))


def refuse_overwriting(out: str, inputs: Iterable[str]) -> None:
    """Refuse to overwrite what is read."""
    for path in inputs:
        if os.path.realpath(path) == os.path.realpath(out):
            raise DataError(f"--out: {out} would overwrite what is read; choose another name.")


def refuse_clashes(places: dict[str, str | None]) -> None:
    """Refuse to write where is read, or twice to one place."""
    seen: dict[str, str] = {}
    for option, place in places.items():
        if place is None:
            continue
        real = os.path.realpath(place)
        if real in seen:
            raise DataError(f"{option}: {place} would overwrite the file of {seen[real]}; choose another name.")
        seen[real] = option
