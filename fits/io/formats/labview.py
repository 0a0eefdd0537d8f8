"""LabVIEW measurement files (.lvm): a header that states separator, units and sampling, then columns."""

import math
from contextlib import suppress
from dataclasses import replace

from fits.io._table import Table, data_error, with_unit
from fits.io._text_table import TextTable, looks_numeric
from fits.io.formats._base import Format, register
from fits.io.formats.csv import checked, chosen, cut, decode, open_csv

_END, _TOP = "***End_of_Header***", "Channels"
_START = "LabVIEW Measurement"


def open_labview(path: str, data: bytes) -> Table:
    """Read the two headers; a `DataError` says that the second, or the line of names, is missing."""
    text = decode(path, data)
    if not text.startswith(_START) and _END not in text:  # written without a header
        return open_csv(path, data)
    lines = text.split("\n")
    separator = "," if any(line.startswith("Separator,") for line in lines[:40]) else "\t"
    ends = [k for k, line in enumerate(lines) if line.startswith(_END)]
    # Every table has a header of its own, below the one of the file, which begins with the number of its channels.
    number, remark = chosen(path, max(len(ends) - 1, 1))
    tops = [k for k, line in enumerate(lines) if line.startswith(_TOP)][number - 1 : number + 1]
    own = range(tops[0] if number > 1 and tops else 0, ends[min(number, len(ends) - 1)] if ends else 0)
    lines = lines[: tops[1] if len(tops) > 1 else None]
    keys = {}
    for line in (lines[k] for k in (*range(ends[0] if ends else 0), *own)):
        key, *cells = line.split(separator)
        keys[key] = [cell.strip() for cell in cells]
    head = next((k for k in range(own.stop + 1, len(lines)) if lines[k].strip()), None) if ends else None
    if head is None:
        raise data_error(path, f"expected {_END} and a line of names below it, found none; export it again", "line 1")
    names = [name.strip() for name in lines[head].split(separator)]
    names = names[: names.index("Comment")] if "Comment" in names else cut(names)
    # Where each channel has a column of x, the cell of its unit stands above that.
    labels = cut(keys.get("Y_Unit_Label", []))
    units = iter(labels[::2] if keys.get("X_Columns", [""])[0] == "Multi" and "" in labels[1::2] else labels)
    timed = keys.get("X_Dimension", ["Time"])[0] == "Time"
    for k, name in enumerate(names):
        # A column of x stands before all others, or before each.
        if name == "X_Value":
            names[k] = "time[s]" if timed else name
        else:
            names[k] = with_unit(name or f"column_{k + 1}", next(units, None))
    for k, name in enumerate(names):
        if name in names[:k]:
            names[k] = f"{name} {k + 1}" if name != "time[s]" else f"X_Value {k + 1}"
    interval_s = None
    if keys.get("X_Columns", [""])[0] == "No" and timed:
        with suppress(ValueError, IndexError):
            interval_s = float(keys["Delta_X"][0].replace(",", "."))
            interval_s = interval_s if math.isfinite(interval_s) and interval_s > 0 else None
    # Without a column of x its cells are there, and empty.
    skip = int(keys.get("X_Columns", [""])[0] == "No" and names[:1] in (["time[s]"], ["X_Value"]))
    body = "\n".join(_cells_of(line, separator, skip, len(names)) for line in lines[head + 1 :])
    found = checked(TextTable(path, tuple(names[skip:]), head + 1, separator, body, interval_s))
    return replace(found, remark=remark)


def _cells_of(line: str, separator: str, skip: int, width: int) -> str:
    """A row without cells that it begins with, and without the comment that may end it."""
    cells = line.split(separator)
    commented = len(cells) == width + 1 and not looks_numeric(cells[width])
    return separator.join(cells[skip : width if commented else None])


register(Format("a LabVIEW measurement file", (".lvm",), (_START.encode(),), open_labview, several=True))
