"""What a sweep is made of: numbers and files of its TOML, parameters, outputs, and the job between them."""

import abc
import math
import os
import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fits.io._errors import DataError, shown
from fits.io._typed import nearest

FloatArray = NDArray[np.float64]
SCHEMA = "microid.sweep/1"
PENDING, DONE, FAILED = 0, 1, 2
STATUS_WORDS = ("pending", "done", "failed")
# Squares and products of what is larger overflow.
_LARGEST = 1e30


@dataclass(frozen=True)
class Parameter:
    """Something a sweep may vary, such as `mechanics.natural_frequency_Hz`; the unit is `"1"` where there is none.

    An array has a nominal value of NaN: it is only varied relative to itself. A row outside the bounds fails with a
    reason. Where it is one of some words, its values are places among them.
    """

    name: str
    unit: str
    nominal: float
    lower: float = -math.inf
    upper: float = math.inf
    words: tuple[str, ...] = ()
    whole: bool = False

    @property
    def range_words(self) -> str:
        unit = "" if self.unit == "1" else f" {self.unit}"
        return f"{self.lower:g} to {self.upper:g}{unit}"


def choice(name: str, words: Sequence[str], nominal: str) -> Parameter:
    """A parameter that is one of some words."""
    return Parameter(name, "1", float(words.index(nominal)), 0.0, len(words) - 1.0, tuple(words))


def one_of(words: Iterable[str], found: Any, place: str, what_to_do: str = "") -> str:
    """What was found, if it is one of some words, or a `DataError` that begins with its place in the sweep."""
    if not isinstance(found, str) or found not in words:
        what_to_do = what_to_do or nearest(str(found), [*words])
        raise DataError(f"{place}: expected one of {', '.join(words)}, found {shown(found)}; {what_to_do}")
    return found


def check_plain(parameter: Parameter, values: FloatArray | None, relative: bool, place: str) -> None:
    """Refuse factors, draws (no values) and fractions of what is a word or a whole number."""
    if not (parameter.words or parameter.whole):
        return
    what = "a choice of words" if parameter.words else "a whole number"
    if relative:
        raise DataError(f"{place}.relative: {parameter.name} is {what}, which no factor changes; give values.")
    if values is None:
        raise DataError(f"{place}: {parameter.name} is {what}, which is not drawn; give values.")
    broken = values[values != np.round(values)]
    if len(broken):
        raise DataError(f"{place}: {parameter.name} is {what}, found {broken[0]:g}; give whole values.")


@dataclass(frozen=True)
class Output:
    """One number, text (such as `'U80'`) or trace per row, named with its unit; `dims` are axes beside the rows."""

    name: str
    unit: str
    meaning: str
    dims: tuple[tuple[str, int], ...] = ()
    dtype: str = "f8"

    @property
    def shape(self) -> tuple[int, ...]:
        return tuple(length for _, length in self.dims)

    @property
    def bytes_per_row(self) -> int:
        """On disk, before compression."""
        return int(np.dtype(self.dtype).itemsize * math.prod(self.shape))

    @property
    def missing(self) -> Any:
        """What stands for it in a row that failed."""
        return "" if self.dtype[0] == "U" else np.full(self.shape, np.nan)


@dataclass(frozen=True)
class Rows:
    """Some rows: outputs by name, shape `(n, ...)`, and why each failed, empty where it did not."""

    outputs: dict[str, NDArray[Any]]
    reasons: tuple[str, ...]

    @classmethod
    def one_by_one(cls, outputs: Sequence[Output], found: Sequence[Mapping[str, Any] | str]) -> "Rows":
        """Rows of which each is its outputs by name, or the reason why it failed."""
        each = [{} if isinstance(row, str) else row for row in found]
        values = {output.name: np.array([row.get(output.name, output.missing) for row in each]) for output in outputs}
        return cls(values, tuple(row if isinstance(row, str) else "" for row in found))


@dataclass(frozen=True)
class Facts:
    """What is known of a job before it runs: all that may be varied, and all that comes out.

    A block of rows is computed together by one device. A row's numbers may depend on its place in the block, and on
    nothing else of the rows beside it; rows that go `alone` are on one device. Sources, such as files, are rows by
    themselves. Coordinates are values along the outputs' own axes: name to axis, unit and values.
    """

    parameters: tuple[Parameter, ...]
    outputs: tuple[Output, ...]
    block: int
    sources: tuple[str, ...] = ()
    coordinates: Mapping[str, tuple[str, str, FloatArray]] = field(default_factory=dict)
    alone: bool = False


@dataclass(frozen=True)
class Block:
    """Rows that are computed together: values by parameter, numbers in the sweep, places of sources, `(n,)` each."""

    values: dict[str, FloatArray]
    relative: tuple[str, ...]
    rows: NDArray[np.int64]
    sources: NDArray[np.int64]
    seed: int

    def numbers(self, name: str, nominal: float) -> FloatArray:
        """Values of a parameter, the nominal one where it does not vary, shape `(n,)`."""
        return self.values.get(name, np.full(len(self.rows), float(nominal)))

    def words(self, name: str, words: Sequence[str], nominal: str) -> list[str]:
        """The word of each row, the nominal one where it does not vary."""
        return [words[int(code)] for code in self.numbers(name, words.index(nominal))]


@dataclass(frozen=True)
class Request:
    """What a job is made from: the sweep as TOML gives it, what gives a file's content by its name, and a folder."""

    table: Mapping[str, Any]
    load: Callable[[str], bytes]
    folder: Path | None


class AbstractJob(abc.ABC):
    """What is done with each row. Rows go through in blocks of one size, one on each local device at once."""

    @property
    @abc.abstractmethod
    def facts(self) -> Facts:
        """What is known before it runs."""

    @abc.abstractmethod
    def compute(self, block: Block) -> Rows:
        """Compute one block on each device."""


def number(found: Any, place: str) -> float:
    """A finite number, or a `DataError` that begins with its place."""
    try:
        value = float(found) if isinstance(found, int | float) and not isinstance(found, bool) else math.nan
    except OverflowError:
        value = math.inf
    if not math.isfinite(value):
        raise DataError(f"{place}: expected a finite number, found {shown(found)}; give one without quotes.")
    if abs(value) > _LARGEST or 0 < abs(value) < 1 / _LARGEST:
        raise DataError(f"{place}: expected 0, or {1 / _LARGEST:g} to {_LARGEST:g} in size, found {value:g}.")
    return value


def in_a_file(content: bytes, name: str, read: Callable[[Path], Any]) -> Any:
    """Read content by a function that reads files; its errors name the file as the sweep does."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / os.path.basename(name)
        path.write_bytes(content)
        try:
            return read(path)
        except DataError as error:
            raise DataError(str(error).replace(str(path), name)) from None
