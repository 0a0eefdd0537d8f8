"""Low-level reading: from bytes to named columns of numbers, with line numbers as an editor shows them."""

import csv
import io
import itertools
import math
import os
import re
from collections.abc import Collection, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from fits.io._errors import AnyPath, DataError
from fits.io._quantity import FloatArray
from fits.io._read_file import MOST_CSV_BYTES, read_bytes, unpack

_COMMENT = re.compile(r"^ *[#%].*\n?", re.MULTILINE)
_EXCEL_SEPARATOR = re.compile(r'"?sep=(.)"?', re.IGNORECASE)
_CONTROL = re.compile(rb"[\x00-\x08\x0e-\x1f]")
_BOMS = {b"\xef\xbb\xbf": "utf-8-sig", b"\xff\xfe": "utf-16", b"\xfe\xff": "utf-16"}
MOST_COLUMNS = 1000
_EXPORT = "export it as CSV text (UTF-8)"


def data_error(path: str, what: str, line: int | None = None, column: str | None = None) -> DataError:
    """Compose the one sentence: file, line and column, then `what` was expected and what to do."""
    place = path
    if line is not None:
        place += f", line {line}"
    if column is not None:
        place += f", column '{column}'"
    return DataError(f"{place}: {what}.")


# First cell of a column that is not a finite number: its physical line, and what was found there.
Problem = tuple[int, str]


@dataclass(frozen=True)
class Table:
    r"""A CSV file whose header is read, without quotes and spaces, and whose body is text whose lines end in `\n`."""

    path: str
    names: tuple[str, ...]
    header_line: int
    separator: str
    body: str

    def read(self, strict: Collection[str]) -> tuple[dict[str, FloatArray], dict[str, Problem]]:
        """Parse all columns: the numeric ones, each of shape (n,), and the first problem of each other.

        A `DataError` refuses what has no rows, rows of another length, and what is not finite in a `strict` column.
        """
        if next(self._lines(), None) is None:
            what = "expected rows of numbers below the header, found none; export again"
            raise self.error(what)
        columns = self._read_fast()
        if columns is None or not all(name in columns for name in strict):
            return self._read_slowly(strict)
        problems = {name: self._first_problem(i) for i, name in enumerate(self.names) if name not in columns}
        return columns, problems

    def error(self, what: str, row: int | None = None, column: str | None = None) -> DataError:
        """The one sentence on a row of the parsed columns, or on the header."""
        return data_error(self.path, what, self.header_line if row is None else self.line(row), column)

    def line(self, row: int) -> int:
        """Physical line, from 1, of a row of the parsed columns, from 0."""
        return next(itertools.islice(self._lines(), row, None))[0]

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

    def _rows(self) -> Iterator[tuple[int, list[str]]]:
        """Physical line numbers and cells; empty cells after the last column (trailing separators) are cut."""
        n = len(self.names)
        for number, text in self._lines():
            cells = split_cells(text, self.separator)
            while len(cells) > n and not cells[-1]:
                cells.pop()
            yield number, cells

    def _read_fast(self) -> dict[str, FloatArray] | None:
        """Columns that pandas finds finite and numeric, or None where the rows need a closer look."""
        import pandas as pd

        n = len(self.names)
        text = self.body
        if '"' in text:
            return None
        if "#" in text or "%" in text:
            text = _COMMENT.sub("", text)
        width = next(self._lines())[1].count(self.separator) + 1
        if width > MOST_COLUMNS:
            return None
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
        if width < n or text.count(self.separator) != (width - 1) * len(frame):
            return None
        if any((frame[i] != "").any() for i in range(n, width)):
            return None
        columns = {}
        for i, name in enumerate(self.names):
            dtype = frame[i].dtype
            if isinstance(dtype, np.dtype) and dtype.kind in "iuf":
                values = frame[i].to_numpy(dtype=np.float64)
                if np.isfinite(values).all():
                    columns[name] = values
        return columns

    def _read_slowly(self, strict: Collection[str]) -> tuple[dict[str, FloatArray], dict[str, Problem]]:
        """Parse cell by cell, so that the first fault in the file can be named."""
        values: list[list[float]] = [[] for _ in self.names]
        problems: dict[str, Problem] = {}
        for line, cells in self._rows():
            if len(cells) != len(self.names):
                raise self._wrong_length(line, len(cells))
            for name, column, cell in zip(self.names, values, cells, strict=True):
                if name in problems:
                    continue
                number = self._number(cell)
                if isinstance(number, float):
                    column.append(number)
                elif name in strict:
                    raise self._bad_cell(line, name, cell, number)
                else:
                    problems[name] = line, number
        columns = {
            name: np.array(column) for name, column in zip(self.names, values, strict=True) if name not in problems
        }
        return columns, problems

    def _first_problem(self, i: int) -> Problem:
        found = ((line, self._number(cells[i])) for line, cells in self._rows())
        other = self.header_line + 1, "a number that pandas does not read"
        return next(((line, text) for line, text in found if isinstance(text, str)), other)

    def _number(self, cell: str) -> float | str:
        """Value of a cell, or what was found instead of a finite number."""
        if not cell:
            return "an empty cell"
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
        elif cell and line == self.line(0):
            remedy = "correct the cell, or put # before the line if it is not data"
        return data_error(self.path, f"expected a finite number, found {found}; {remedy}", line, name)

    def _wrong_length(self, line: int, found: int) -> DataError:
        n = len(self.names)
        which = "missing" if found < n else "surplus"
        column = self.names[found] if found < n else self.names[-1]
        hint = " (decimal commas need ; or tab between cells)" if self.separator == "," and found > n else ""
        what = (
            f"expected {n} cells as in the header in line {self.header_line}, found {found}; "
            f"correct the {which} cells{hint} or remove the line"
        )
        return data_error(self.path, what, line, column)


def open_table(path: AnyPath) -> Table:
    """Read a file and its header; a `DataError` says that this is no readable text with a header of its own."""
    shown = os.fspath(path)
    data = read_bytes(shown, "a CSV file", MOST_CSV_BYTES)
    if data.startswith(b"\x1f\x8b") or shown.lower().endswith(".gz"):
        data = unpack(data, shown, MOST_CSV_BYTES)
    text = _decode(shown, data)
    header_line, separator, header, end = _find_header(shown, text)
    names = [name.strip() for name in split_cells(header, separator)]
    while names and not names[-1]:  # trailing separators
        names.pop()
    if all(_looks_numeric(name) for name in names):
        what = (
            "expected a header such as time_s,voltage_V,displacement_um, found numbers; insert the header above this "
            "line, without # before it"
        )
        raise data_error(shown, what, header_line, names[0] if names else None)
    if len(names) > MOST_COLUMNS:
        what = f"expected up to {MOST_COLUMNS:,} columns, found {len(names):,}; write a row per sample"
        raise data_error(shown, what, header_line)
    names = [name or f"column_{i}" for i, name in enumerate(names, 1)]
    for i, name in enumerate(names):
        if name in names[:i]:
            first = names.index(name) + 1
            what = f"expected each header once, found it in cells {first} and {i + 1}; rename or remove one"
            raise data_error(shown, what, header_line, name)
    return Table(shown, tuple(names), header_line, separator, text[end:])


def _decode(path: str, data: bytes) -> str:
    if not data.strip():
        raise data_error(path, "expected a header and rows of numbers, found an empty file; export again", 1)
    if data.startswith(b"PK\x03\x04"):
        raise data_error(path, f"expected text, found an Excel workbook or zip archive; {_EXPORT}", 1)
    encoding = next((name for bom, name in _BOMS.items() if data.startswith(bom)), "utf-8")
    control = _CONTROL.search(data, 0, 65536)
    first = control.start() if control else data.find(b"\0")
    if encoding != "utf-16" and first >= 0:
        line = data.count(b"\n", 0, first) + 1
        raise data_error(path, f"expected text, found binary data (byte {first}); {_EXPORT}", line)
    try:
        text = data.decode(encoding)
    except UnicodeDecodeError:
        if encoding == "utf-16":
            raise data_error(path, f"expected UTF-16 text, found damaged characters; {_EXPORT}", 1) from None
        text = data.decode("latin-1")
    return text.replace("\r\n", "\n").replace("\r", "\n") if "\r" in text else text


def _find_header(path: str, text: str) -> tuple[int, str, str, int]:
    """Line, separator and text of the header, and the offset at which the body begins."""
    separator, end = "", 0
    for number, line in enumerate(io.StringIO(text, newline="\n"), 1):
        end += len(line)
        stripped = line.strip(" \n")
        declared = _EXCEL_SEPARATOR.fullmatch(stripped)
        if declared:
            separator = declared[1]
        elif line.strip() and not stripped.startswith(("#", "%")):
            unquoted = re.sub(r'"[^"]*"', "", line.strip())
            # Names in a semicolon file may hold commas; the reverse is rare.
            separator = separator or next((mark for mark in "\t;" if mark in unquoted), ",")
            return number, separator, line.removesuffix("\n"), end
    raise data_error(path, "expected a header and rows of numbers, found only comments; export again", 1)


def split_cells(line: str, separator: str) -> list[str]:
    """Cells of one line, without the spaces and quotes around them."""
    cells = line.split(separator)
    if '"' in line:
        with suppress(csv.Error):  # a cell beyond 128 KiB is no number either way
            cells = next(csv.reader([line], delimiter=separator, skipinitialspace=True))
    return [cell.strip() for cell in cells]


def _looks_numeric(cell: str) -> bool:
    try:
        float(cell.replace(",", "."))
    except ValueError:
        return not cell
    return True
