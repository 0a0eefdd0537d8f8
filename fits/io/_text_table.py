"""Columns in text: from lines to numbers, with line numbers as an editor shows them."""

import csv
import io
import itertools
import math
import re
from collections.abc import Collection, Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fits.io._clock import clock_s, is_clock
from fits.io._errors import DataError
from fits.io._quantity import FloatArray
from fits.io._table import MOST_COLUMNS, Problem, Table, data_error

_COMMENT = re.compile(r"^ *[#%].*\n?", re.MULTILINE)
# To import pandas takes longer than NumPy takes to read so many characters.
_FEW = 5_000_000
# What programs write for a number that is missing, beside words and dashes without a digit.
_MISSING = {"1.#qnan", "-1.#ind"}
_EMPTY = "an empty cell"


@dataclass(frozen=True)
class TextTable(Table):
    r"""A text whose header is read, without quotes and spaces, and whose body is text whose lines end in `\n`.

    `clocks` are the columns whose cells are ISO 8601 time stamps.
    """

    path: str
    names: tuple[str, ...]
    header_line: int
    separator: str
    body: str
    interval_s: float | None = None
    headed: bool = True
    clocks: frozenset[str] = field(default_factory=frozenset)
    remark: str = ""

    def read(self, strict: Collection[str]) -> tuple[dict[str, FloatArray], dict[str, Problem]]:
        if next(self._lines(), None) is None:
            raise self.error("expected rows of numbers below the header, found none; export again")
        columns = self._read_fast()
        if columns is None or not all(name in columns for name in strict):
            return self._read_slowly(strict)
        problems = {name: self._first_problem(i) for i, name in enumerate(self.names) if name not in columns}
        return columns, self._worth_a_word(problems)

    def place(self, row: int | None = None) -> str:
        """The physical line, from 1."""
        if row is None and self.headed:
            return f"line {self.header_line}"
        return f"line {next(itertools.islice(self._lines(), row or 0, None))[0]}"

    def without_missing(self, strict: Collection[str]) -> tuple[Table, NDArray[np.bool_]]:
        """Leave out rows with an empty cell, or a NaN of some spelling; see `Table`."""
        lines, kept = io.StringIO(self.body, newline="\n").readlines(), []
        at = [i for i, name in enumerate(self.names) if name in strict]
        for number, cells in self.rows():
            missing = any(is_missing(cells[i]) for i in at if i < len(cells))
            kept.append(not missing)
            if missing:  # a blank line, so that those below keep their numbers
                lines[number - self.header_line - 1] = "\n"
        return replace(self, body="".join(lines)), np.array(kept, dtype=bool)

    @cached_property
    def decimal(self) -> str:
        """Decimal mark: that of the first cell which has one."""
        if self.separator == ",":
            return "."
        edge = re.escape(self.separator)
        cell = rf'(?:^|{edge})[ "]*[+-]?\d*([.,])\d+(?:[eE][+-]?\d+)?[ "]*(?={edge}|$)'
        match = re.search(cell, self.body, re.MULTILINE)
        return match[1] if match else "."

    def _lines(self) -> Iterator[tuple[int, str]]:
        """Physical line numbers and texts of the rows; comments and rows of empty cells are skipped."""
        empty = " \t\r\n" + self.separator
        # StringIO splits at \n only; str.splitlines would also split at characters that editors do not count.
        for number, text in enumerate(io.StringIO(self.body, newline="\n"), self.header_line + 1):
            start = text.strip(empty)
            if start and not text.lstrip(" ").startswith(("#", "%")):
                yield number, text.removesuffix("\n")

    def rows(self) -> Iterator[tuple[int, list[str]]]:
        """Physical line numbers and cells; empty cells after the last column (trailing separators) are cut."""
        n = len(self.names)
        for number, text in self._lines():
            cells = split_cells(text, self.separator)
            while len(cells) > n and not cells[-1]:
                cells.pop()
            yield number, cells

    def _read_fast(self) -> dict[str, FloatArray] | None:
        """Columns that are finite and numeric throughout, or None where the rows need a closer look."""
        n, width = len(self.names), next(self._lines())[1].count(self.separator) + 1
        if '"' in self.body or width > MOST_COLUMNS:
            return None
        text = _COMMENT.sub("", self.body) if "#" in self.body or "%" in self.body else self.body
        if width == n and len(text) <= _FEW and re.fullmatch(rf"[-+.eE0-9 \n{re.escape(self.separator)}]*", text):
            with suppress(ValueError):
                values = np.loadtxt(io.StringIO(text), delimiter=self.separator, comments=None, ndmin=2)
                columns = dict(zip(self.names, np.ascontiguousarray(values.T), strict=True))
                return {name: column for name, column in columns.items() if np.isfinite(column).all()}
        import pandas as pd

        options: dict[str, Any] = {}
        if tuple(int(part) for part in pd.__version__.split(".")[:2]) < (3, 1):
            options["float_precision"] = "round_trip"  # the only mode from 3.1 on, where naming it warns
        try:
            frame = pd.read_csv(
                io.BytesIO(text.encode()),
                sep=self.separator,
                decimal=self.decimal,
                header=None,
                names=list(range(max(n, width))),
                index_col=False,
                na_filter=False,
                low_memory=False,
                skipinitialspace=True,
                **options,
            )
        except (pd.errors.ParserError, ValueError):
            return None
        # pandas pads short rows without a word; counting the separators finds them.
        whole = width >= n and text.count(self.separator) == (width - 1) * len(frame)
        if not whole or any((frame[i] != "").any() for i in range(n, width)):
            return None
        columns = {}
        for i, name in enumerate(self.names):
            dtype = frame[i].dtype
            if name in self.clocks:
                try:
                    columns[name] = clock_s(frame[i].to_list())
                except (ValueError, TypeError):
                    return None
            if isinstance(dtype, np.dtype) and dtype.kind in "iuf":
                values = frame[i].to_numpy(dtype=np.float64)
                if np.isfinite(values).all():
                    columns[name] = values
        return columns

    def _read_slowly(self, strict: Collection[str]) -> tuple[dict[str, FloatArray], dict[str, Problem]]:
        """Parse cell by cell, so that the first fault in the file can be named."""
        values: list[list[Any]] = [[] for _ in self.names]
        problems: dict[str, Problem] = {}
        for line, cells in self.rows():
            if len(cells) != len(self.names):
                raise self._wrong_length(line, len(cells))
            for name, column, cell in zip(self.names, values, cells, strict=True):
                if name in problems:
                    continue
                if name in self.clocks and is_clock(cell):
                    column.append(cell)
                    continue
                number = self._number(cell) if name not in self.clocks else f"'{cell[:30]}'"
                if isinstance(number, float):
                    column.append(number)
                elif name in strict:
                    raise self._bad_cell(line, name, cell, number)
                else:
                    problems[name] = f"line {line}", number
        columns = {}
        for name, column in zip(self.names, values, strict=True):
            if name not in problems:
                try:
                    columns[name] = clock_s(column) if name in self.clocks else np.array(column)
                except ValueError as error:
                    raise self.error(
                        f"expected time stamps, found one that is none ({error}); correct it", 0, name
                    ) from None
        return columns, self._worth_a_word(problems)

    def _first_problem(self, i: int) -> Problem:
        found = ((line, self._number(cells[i])) for line, cells in self.rows())
        other = f"line {self.header_line + 1}", "a number that pandas does not read"
        return next(((f"line {line}", text) for line, text in found if isinstance(text, str)), other)

    def _worth_a_word(self, problems: dict[str, Problem]) -> dict[str, Problem]:
        """Problems but those of columns that are empty throughout."""
        at = {name: i for i, name in enumerate(self.names)}
        empty = [name for name, (_, found) in problems.items() if found == _EMPTY]
        empty = [name for name in empty if not any(cells[at[name]] for _, cells in self.rows())]
        return {name: each for name, each in problems.items() if name not in empty}

    def _number(self, cell: str) -> float | str:
        """Value of a cell, or what was found instead of a finite number."""
        if not cell:
            return _EMPTY
        found = f"'{cell if len(cell) <= 30 else cell[:27] + '...'}'"
        if "_" in cell or (self.decimal == "," and "." in cell):
            return found
        try:
            number = float(cell.replace(",", ".") if self.decimal == "," else cell)
        except ValueError:
            return found
        return number if math.isfinite(number) else found

    def _bad_cell(self, line: int, name: str, cell: str, found: str) -> DataError:
        remedy = "correct the cell, or remove its line or a column that is not needed"
        if re.fullmatch(r"[+-]?\d+[.,]\d+(?:[eE][+-]?\d+)?", cell):
            remedy = "write all numbers with one decimal mark, and separate cells by ; or tab where it is a comma"
        elif is_missing(cell) and not (self.place(0) == f"line {line}" and cell and "nan" not in cell.lower()):
            remedy = "correct the cell, or leave out such lines with --missing drop"
        elif self.place(0) == f"line {line}":
            remedy = "correct the cell, or put # before the line if it is not data"
        expected = "a time stamp" if name in self.clocks else "a finite number"
        return data_error(self.path, f"expected {expected}, found {found}; {remedy}", f"line {line}", name)

    def _wrong_length(self, line: int, found: int) -> DataError:
        n = len(self.names)
        which = "missing" if found < n else "surplus"
        column = self.names[found] if found < n else self.names[-1]
        hint = " (decimal commas need ; or tab between cells)" if self.separator == "," and found > n else ""
        first = f"the {'header' if self.headed else 'first row'} in {self.place()}"
        what = f"expected {n} cells as in {first}, found {found}; correct the {which} cells{hint} or remove the line"
        return data_error(self.path, what, f"line {line}", column)


def is_missing(cell: str) -> bool:
    """Whether a cell stands for a number that is missing: one without a digit, such as `NaN` or `overload`."""
    return cell.lower() in _MISSING or not any(map(str.isdigit, cell))


def looks_numeric(cell: str) -> bool:
    """Whether a cell is a number, with a point or a comma, or empty."""
    try:
        float(cell.replace(",", "."))
    except ValueError:
        return not cell
    return True


def split_cells(line: str, separator: str) -> list[str]:
    """Cells of one line, without the spaces and quotes around them."""
    cells = line.split(separator)
    if '"' in line:
        with suppress(csv.Error):  # a cell beyond 128 KiB is no number either way
            cells = next(csv.reader([line], delimiter=separator, skipinitialspace=True))
    return [cell.strip() for cell in cells]
