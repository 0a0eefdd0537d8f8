"""Text of numbers between commas, semicolons or tabs: with or without a header, and perhaps with lines above it."""

import io
import itertools
import re
from collections.abc import Iterator
from dataclasses import replace

from fits.io._clock import is_clock
from fits.io._read_file import numbered
from fits.io._table import MOST_COLUMNS, Table, data_error, with_unit
from fits.io._text_table import TextTable, looks_numeric, split_cells
from fits.io._units import is_unscaled, known_quantity, known_unit, recognise
from fits.io.formats._base import Format, register

_EXCEL_SEPARATOR = re.compile(r'"?sep=(.)"?', re.IGNORECASE)
_DATE = re.compile(r"\d{1,4}([./-])\d{1,2}\1\d{1,4}")
_CONTROL = re.compile(rb"[\x00-\x08\x0e-\x1f]")
_BOMS = {b"\xef\xbb\xbf": "utf-8-sig", b"\xff\xfe": "utf-16", b"\xfe\xff": "utf-16"}
_EXPORT = "export it as CSV text (UTF-8)"
# So many lines, or characters, are looked at for the first rows of numbers, and so many rows are a table.
_HEAD, _HEAD_CHARACTERS, _ENOUGH = 300, 1_000_000, 3
# A first line with line breaks within quotes.
_BROKEN_HEADER = re.compile(r'(?=[^\n]*"[^"\n]*\n)([^"\n]*"[^"]{0,100}")+[^"\n]*(?=\n)')
# What may stand between two tables, and how far a second one is looked for behind it, in characters and lines.
_GAP = re.compile(r"\n(?:[ \t,;]*\n)+")
_AHEAD, _FEW_LINES = 4000, 8

# Number from 1, beginning and text of a line that is neither blank nor a comment.
_Line = tuple[int, int, str]


def open_csv(path: str, data: bytes) -> Table:
    """Find the table in a text, or the one that the path numbers; a `DataError` says that there is none."""
    text = decode(path, data)
    broken = _BROKEN_HEADER.match(text)
    if broken and "\n" in broken[0]:  # as cells of a spreadsheet are; the lines below keep their numbers
        text = broken[0].replace("\n", " ") + "\n" * broken[0].count("\n") + text[broken.end() :]
    if _spaced(text):
        text = re.sub(r"(?<=\S) +(?=[^\s(\[])", "\t", text)  # but for those ahead of a unit in brackets
    starts = [*_beginnings(text), len(text)]
    number, remark = chosen(path, len(starts) - 1)
    begin, end = starts[number - 1 : number + 1]
    above = text.count("\n", 0, begin)
    # Blank lines, so that lines keep their numbers.
    return replace(_open_text(path, "\n" * above + text[begin:end]), remark=remark)


def chosen(path: str, count: int) -> tuple[int, str]:
    """Which of so many tables of a file is meant, from 1, and what is to be said where none was named."""
    file, number = numbered(path)
    if number is not None and number > count:
        raise data_error(path, f"expected a table from 1 to {count}, found number {number}; choose another")
    remark = f"{file}: it holds {count} tables, and the first was read; the second is {file}#2."
    return number or 1, "" if number or count == 1 else remark


def _beginnings(text: str) -> Iterator[int]:
    """Where tables begin: at the top, and at names of as many columns as follow, after rows and a blank line."""
    yield 0
    for gap in _GAP.finditer(text):
        before = text[text.rfind("\n", 0, gap.start()) + 1 : gap.start()]
        lines = [before, *text[gap.end() : gap.end() + _AHEAD].split("\n")[:_FEW_LINES]]
        lines = [line for line in lines if line.strip() and not line.lstrip().startswith(("#", "%"))]
        rows = [_names(line, _separator(line)) for line in lines]
        numbers = [_all_numbers(row) for row in rows]
        if numbers[:2] == [True, False] and True in numbers[2:]:
            first = numbers.index(True, 2)
            if len(rows[first]) > 1 and any(len(row) == len(rows[first]) for row in rows[1:first]):
                yield gap.end()


def _open_text(path: str, text: str) -> TextTable:
    declared, lines = _first_lines(text)
    if not lines:
        raise data_error(path, "expected a header and rows of numbers, found only comments; export again", "line 1")
    if lines[0][2].lstrip().startswith("{"):
        what = "expected a header and rows of numbers, found JSON; name a table (microid info shows a model file)"
        raise data_error(path, what, f"line {lines[0][0]}")
    k, separator, first, units = _header(lines, declared)
    if first == k or _all_numbers(_names(lines[k][2], separator)):
        # A comment may be the header, if it states a unit.
        _, noted = _first_lines(text, comments=True)
        at, mark, below, unit_line = _header(noted, declared)
        number, start, line = lines[k]
        width, said = len(_names(line, separator)), _names(noted[at][2], mark)
        if unit_line is None and not (len(said) == width and any(map(known_unit, said))):
            numbered = tuple(str(i) for i in range(1, width + 1))
            return checked(TextTable(path, numbered, number - 1, separator, text[start:], None, False))
        lines, k, separator, first, units = noted, at, mark, below, unit_line
    number, _, line = lines[k]
    names = _names(line, separator)
    if len(names) > MOST_COLUMNS:
        what = f"expected up to {MOST_COLUMNS:,} columns, found {len(names):,}; write a row per sample"
        raise data_error(path, what, f"line {number}")
    names = [name or f"column_{i}" for i, name in enumerate(names, 1)]
    if units is not None:
        below_names = split_cells(lines[units][2], separator)[: len(names)]
        names = [with_unit(name, unit) for name, unit in itertools.zip_longest(names, below_names)]
    again = [i for i, name in enumerate(names) if name in names[:i]]
    for i in again:
        names[i] = f"{names[i]} {i + 1}"
    # Blank lines in place of what stands between, so that those below keep their numbers.
    below, start, _ = lines[first] if first < len(lines) else (number + 1, len(text), "")
    body = "\n" * (below - number - 1) + text[start:]
    return checked(TextTable(path, tuple(names), number, separator, body))


def checked(table: TextTable) -> TextTable:
    """A table of which it is known which columns are time stamps, and end so in the unit s."""
    _, first = next(table.rows(), (0, []))
    clocks = {name for name, cell in zip(table.names, first, strict=False) if is_clock(cell)}
    names = tuple(with_unit(name, "s") if name in clocks and table.headed else name for name in table.names)
    timed = frozenset(new for old, new in zip(table.names, names, strict=True) if old in clocks)
    return replace(table, names=names, clocks=timed)


def decode(path: str, data: bytes) -> str:
    r"""Text of a file, whose lines end in `\n`."""
    if not data.strip():
        raise data_error(path, "expected a header and rows of numbers, found an empty file; export again", "line 1")
    if data.startswith(b"PK\x03\x04"):
        raise data_error(path, f"expected text, found an Excel workbook or zip archive; {_EXPORT}", "line 1")
    encoding = next((name for bom, name in _BOMS.items() if data.startswith(bom)), "utf-8")
    control = _CONTROL.search(data, 0, 65536)
    first = control.start() if control else data.find(b"\0")
    if encoding != "utf-16" and first >= 0:
        line = data.count(b"\n", 0, first) + 1
        raise data_error(path, f"expected text, found binary data (byte {first}); {_EXPORT}", f"line {line}")
    try:
        text = data.decode(encoding)
    except UnicodeDecodeError:
        if encoding == "utf-16":
            raise data_error(path, f"expected UTF-16 text, found damaged characters; {_EXPORT}", "line 1") from None
        text = data.decode("latin-1")
    return text.replace("\r\n", "\n").replace("\r", "\n") if "\r" in text else text


def cut(cells: list[str]) -> list[str]:
    """Cells without the empty ones at the end, which trailing separators make."""
    while cells and not cells[-1]:
        cells.pop()
    return cells


def _spaced(text: str) -> bool:
    """Whether spaces alone separate the numbers of rows."""
    for line in text[:_HEAD_CHARACTERS].split("\n")[:_HEAD]:
        cells = line.split()
        if len(cells) > 1 and all(looks_numeric(cell) and cell.strip(",") == cell for cell in cells):
            return "\t" not in line.strip()
    return False


def _first_lines(text: str, comments: bool = False) -> tuple[str, list[_Line]]:
    """The separator, if a line declares it, and the first lines that are not blank, with or without comments."""
    separator, lines, start = "", list[_Line](), 0
    for number, line in enumerate(io.StringIO(text, newline="\n"), 1):
        stripped = line.strip(" \n")
        declared = _EXCEL_SEPARATOR.fullmatch(stripped)
        if declared and not lines:
            separator = declared[1]
        elif (
            said := stripped.lstrip("#% \t") if comments else "" if stripped.startswith(("#", "%")) else line.strip()
        ):
            lines.append((number, start, said if said != line.strip() else line.removesuffix("\n")))
            if len(lines) == _HEAD:
                break
        start += len(line)
    return separator, lines


def _header(lines: list[_Line], declared: str) -> tuple[int, str, int, int | None]:
    """Which line is the header, what separates its cells, which is the first row, and which holds units, if any does.

    A separator that the file has declared serves for all lines.

    It is the first line, unless rows of numbers are found below others that are no rows of theirs: then the first of
    the lines above them, of as many cells, that names a known quantity, or the last words above the units.
    """
    for i in range(len(lines)):
        separator = declared or _separator(lines[i][2])
        rows = [_names(line, separator) for _, _, line in lines[i : i + _ENOUGH]]
        if not all(len(row) == len(rows[0]) and any(row) and _all_numbers(row) for row in rows):
            continue
        wide, first = len(split_cells(lines[i][2], separator)), i
        while first and _is_as_wide(lines[first - 1][2], separator, wide, len(rows[0])):
            first -= 1
        # What stands above a column without numbers says what the line is, as in the captures of dSPACE.
        filled = [k for k in range(len(rows[0])) if any(row[k] for row in rows)]
        above: dict[int, list[str]] = {}
        for k in range(first, i):
            cells = [*split_cells(lines[k][2], separator), *rows[0]][: len(rows[0])]
            if any(cells[j] for j in filled):
                above[k] = [cells[j] for j in filled if cells[j]]
        if not above:
            break
        if all(all(map(_is_number, cells)) for cells in above.values()):
            # Words beside the first rows of numbers, as in captures of Tektronix: there is no header.
            return min(above), separator, min(above), None
        units = [k for k, cells in above.items() if _are_units(cells)]
        # A row of which some cells are empty is a row.
        words = [k for k, cells in above.items() if k not in units and not all(map(_is_number, cells))]
        named = [k for k, cells in above.items() if any(map(recognise, cells))]
        over = [k for k in words if units and k < units[-1]]
        k = next(iter(named), (over or words or [*above])[-1])
        # A row of which a cell is damaged is a row.
        damaged = [j for j in above if j > k and any(map(_is_number, above[j]))]
        return k, separator, min([*damaged, i]), next((each for each in units if each > k), None)
    return 0, declared or _separator(lines[0][2]), 1, None


def _is_as_wide(line: str, separator: str, wide: int, width: int) -> bool:
    """Whether a line has as many cells as rows have, with the empty ones at the end or without."""
    cells = split_cells(line, separator)
    return len(cells) == wide or len(cut(cells)) == width


def _all_numbers(cells: list[str]) -> bool:
    return all(not cell or _is_number(cell) for cell in cells)


def _is_number(cell: str) -> bool:
    return bool(cell) and (looks_numeric(cell) or is_clock(cell) or _DATE.fullmatch(cell) is not None)


def _names(line: str, separator: str) -> list[str]:
    return cut(split_cells(line, separator))


def _separator(line: str) -> str:
    unquoted = re.sub(r'"[^"]*"', "", line.strip())
    # Names in a semicolon file may hold commas; the reverse is rare.
    return next((mark for mark in "\t;|" if mark in unquoted), ",")


def _are_units(cells: list[str]) -> bool:
    """Whether cells are units of columns: most of them known ones, or the first one of time, whatever the others."""
    plain = [cell.strip(" []()") for cell in cells]
    known = [cell in ("", "-", "1") or known_unit(f"x[{cell}]") or is_unscaled(cell) for cell in plain]
    return 2 * sum(map(bool, known)) > len(cells) or known_unit(f"x[{plain[0]}]") in known_quantity("time_s").powers


register(Format("a CSV file", (".csv", ".txt", ".dat", ".asc", ".tsv"), (), open_csv, several=True))
