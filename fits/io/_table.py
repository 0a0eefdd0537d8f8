"""What every file is opened to: named columns, which the mapping of columns chooses from."""

import re
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Collection, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fits.io._clock import clock_s, is_clock, seconds
from fits.io._errors import DataError
from fits.io._quantity import FloatArray, split_unit

MOST_COLUMNS = 1000
# How names of the columns of a record begin.
_SPOKEN = re.compile(r"(time|voltage|displacement)\b|(time|voltage|displacement)_", re.IGNORECASE)
# Where the first cell of a column stands that is not a finite number, and what was found there.
Problem = tuple[str, str]
# The groups that an array stands in and its name, values of any shape, and a unit if one is stated.
Found = tuple[tuple[str, ...], Any, str | None]


def data_error(path: str, what: str, place: str = "", column: str | None = None) -> DataError:
    """Compose the one sentence: file, line or row, and column, then `what` was expected and what to do."""
    where = path + (f", {place}" if place else "") + ("" if column is None else f", column '{column}'")
    return DataError(f"{where}: {what}.")


class Table(ABC):
    """A file whose columns have names, which end in their units where they are known.

    `interval_s` is what the file says of even sampling, or None; `headed` is False where names are numbers from 1 on,
    as the file has none; `remark` is a sentence on what else is in the file, or empty.
    """

    path: str
    names: tuple[str, ...]
    interval_s: float | None
    headed: bool
    remark: str

    @abstractmethod
    def read(self, strict: Collection[str]) -> tuple[dict[str, FloatArray], dict[str, Problem]]:
        """Read all columns: the numeric ones, each of shape (n,), and the first problem of each other.

        A `DataError` refuses what has no rows, rows of another length, and what is not finite in a `strict` column.
        """

    @abstractmethod
    def without_missing(self, strict: Collection[str]) -> tuple["Table", NDArray[np.bool_]]:
        """Leave out the rows where a value of a `strict` column is missing; which of them are kept, shape (n,)."""

    @abstractmethod
    def place(self, row: int | None = None) -> str:
        """Where a row of what is read stands in the file, from 0, or the header."""

    def error(self, what: str, row: int | None = None, column: str | None = None) -> DataError:
        """The one sentence on a row of the parsed columns, or on the header."""
        return data_error(self.path, what, self.place(row), column)


@dataclass(frozen=True)
class ArrayTable(Table):
    """Columns that are arrays already, shape (n,) each; `rows` counts from 0 those that are left."""

    path: str
    arrays: Mapping[str, FloatArray]
    interval_s: float | None = None
    headed: bool = True
    remark: str = ""
    rows: NDArray[np.int64] | None = None

    @property
    def names(self) -> tuple[str, ...]:  # type: ignore[override]
        return tuple(self.arrays)

    def read(self, strict: Collection[str]) -> tuple[dict[str, FloatArray], dict[str, Problem]]:
        columns, problems = {}, {}
        for name, array in self.arrays.items():
            good = np.isfinite(array)
            if not array.size:
                raise self.error("expected rows of numbers, found none; export again", None, name)
            if good.all():
                columns[name] = array
                continue
            row = int(np.argmin(good))
            found = str(array[row])
            if name in strict:
                missing = "no number (nan); correct it, or leave such rows out with --missing drop"
                said = missing if found == "nan" else f"{found}; correct it"
                raise self.error(f"expected a finite number, found {said}", row, name)
            problems[name] = self.place(row), found
        return columns, problems

    def without_missing(self, strict: Collection[str]) -> tuple[Table, NDArray[np.bool_]]:
        """Leave out rows with NaN; see `Table`."""
        kept = ~np.any([np.isnan(self.arrays[name]) for name in strict], axis=0)
        arrays = {name: array[kept] for name, array in self.arrays.items()}
        return ArrayTable(self.path, arrays, self.interval_s, self.headed, rows=np.flatnonzero(kept)), kept

    def place(self, row: int | None = None) -> str:
        """Rows are counted from 1."""
        return "" if row is None else f"row {(row if self.rows is None else int(self.rows[row])) + 1}"


def with_unit(name: str, unit: str | None) -> str:
    """A name that ends in its unit, if one is stated beside it and the name has none."""
    plain = split_unit(f"x[{(unit or '').strip(' []()')}]")[1]
    return name if plain in (None, "-", "1") or split_unit(name)[1] == plain else f"{name}[{plain}]"


def gathered(path: str, what: str, found: Iterable[Found], interval_s: float | None = None) -> ArrayTable:
    """Make a table of what a file holds: the arrays of the length that most columns of a record have, or else most.

    A matrix has a column for each of its shorter side, a compound array one for each field. Groups are left out of
    the names where that leaves them different. A `DataError` says that there is no array, and `what` was expected.
    """
    flat = [(full, column, unit) for name, values, unit in found for full, column in _columns(name, values)]
    lengths = Counter(len(column) for _, column, _ in flat)
    if not lengths:
        raise DataError(
            f"{path}: expected {what} with arrays of numbers, found none; store time, voltage and displacement as "
            "plain arrays of one length."
        )
    # Spectra and settings may be more than the columns of a record, which say so by their names.
    named = Counter(len(column) for name, column, unit in flat if _SPOKEN.match(with_unit(name[-1], unit)))
    length = max(lengths, key=lambda n: (named[n], lengths[n], n))
    kept = [(name, column, unit) for name, column, unit in flat if len(column) == length]
    last = Counter(name[-1] for name, _, _ in kept)
    arrays: dict[str, FloatArray] = {}
    for name, column, unit in kept[: MOST_COLUMNS + 1]:
        full, again = name[-1] if last[name[-1]] == 1 else "/".join(name), 1
        shown = with_unit(full, unit)
        while shown in arrays:
            again += 1
            shown = with_unit(f"{full} {again}", unit)
        arrays[shown] = column
    if len(kept) > MOST_COLUMNS:
        raise DataError(f"{path}: expected up to {MOST_COLUMNS:,} columns, found {len(kept):,}; leave some out.")
    return ArrayTable(path, arrays, interval_s)


def of_frame(path: str, frame: Any, units: Mapping[str, str] | None = None) -> ArrayTable:
    """Columns of a `DataFrame`, its index among them if it has a name or holds times."""
    import pandas as pd

    index = frame.index
    if index.name is not None or index.nlevels > 1 or index.dtype.kind in "mM":
        frame = frame.reset_index(names=None if index.nlevels > 1 else [index.name or "time"])
    found = []
    for k, name in enumerate(frame.columns):
        column, words = frame.iloc[:, k], "_".join(map(str, name)) if isinstance(name, tuple) else str(name)
        if getattr(column.dtype, "tz", None) is not None:
            column = column.dt.tz_convert(None)
        if column.dtype.kind == "O":  # numbers beside words, or decimal ones; what is none is missing
            numbers = pd.to_numeric(column, errors="coerce")
            column = numbers if numbers.notna().any() else column
        values = column.to_numpy(np.float64, na_value=np.nan) if column.dtype.kind in "iuf" else column.to_numpy()
        found.append(((words,), values, (units or {}).get(words)))
    return gathered(path, "a table", found)


def _columns(name: tuple[str, ...], values: Any) -> Iterable[tuple[tuple[str, ...], FloatArray]]:
    """Columns of an array that a file names, by their names; nothing of what holds no numbers, or one alone."""
    array = np.squeeze(np.asarray(values))
    if array.dtype.names:
        for field in array.dtype.names:
            yield from _columns((*name, field), array[field])
    elif array.ndim == 1 and array.size > 1 and array.dtype.kind in "mM" and not np.isnat(array).all():
        yield (*name[:-1], with_unit(name[-1], "s")), seconds(array)
    elif array.ndim == 1 and array.size > 1 and array.dtype.kind in "SUO":
        cells = [one.decode("latin-1") if isinstance(one, bytes) else one for one in array.tolist()]
        with suppress(ValueError):  # texts that are no time stamps, and columns of other things, hold no numbers
            if all(isinstance(one, str) for one in cells) and is_clock(cells[0]):
                yield (*name[:-1], with_unit(name[-1], "s")), clock_s(cells)
    elif array.ndim == 1 and array.size > 1 and array.dtype.kind in "iuf":
        yield name, array.astype(np.float64, copy=False)
    elif array.ndim == 2 and array.dtype.kind in "iuf":
        rows = array if array.shape[0] >= array.shape[1] else array.T
        for k in range(min(rows.shape[1], MOST_COLUMNS + 1)):
            yield (*name[:-1], f"{name[-1]}_{k + 1}"), rows[:, k].astype(np.float64)
