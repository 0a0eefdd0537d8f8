"""The axes of a sweep as its TOML states them, checked against the parameters there are."""

import csv
import io
import math
import re
from collections.abc import Callable, Mapping, Sequence
from difflib import get_close_matches
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import Meta

from fits.io._errors import DataError, shown
from fits.io._typed import typed
from fits.sweeps._axes import SAMPLERS, Axis, Drawn, Listed, Plan
from fits.sweeps._types import Parameter, check_plain, number, one_of

_PREFIXES = {"": 0, "k": 3, "M": 6, "m": -3, "u": -6, "n": -9}
_UNIT = re.compile(r"([kMmun]?)(s|V|m|Hz|Pa|rad)")
_MOST_ROWS = 2**62
# Values of a grid are held at once.
_LONGEST = 1_000_000
# Keys beside those that every axis may have, by the one that says where its values come from.
_WAYS = {"values": ("values", "zip"), "low": ("low", "high", "count", "spacing", "zip"), "mean": ("mean", "sd")}


class _Axis(msgspec.Struct):
    """A table `[[axis]]`; what belongs together is checked by `_values`."""

    parameter: Annotated[str, Meta(description="the name of what varies")]
    unit: Annotated[str | None, Meta(description="a unit in quotes")] = None
    relative: Annotated[bool, Meta(description="true or false")] = False
    values: Any = None
    low: Any = None
    high: Any = None
    mean: Any = None
    sd: Any = None
    spacing: Annotated[Literal["linear", "log"], Meta(description="linear or log")] = "linear"
    count: Annotated[int | None, Meta(description="a number of 1 or more")] = None
    zip: Annotated[str | None, Meta(description="a name that zipped axes share")] = None


class _Design(msgspec.Struct):
    """The table `[design]`."""

    method: Annotated[
        Literal["random", "latin_hypercube", "sobol"], Meta(description=f"one of {', '.join(SAMPLERS)}")
    ]
    rows: Annotated[int, Meta(ge=1, le=_MOST_ROWS, description="a number from 1 to 2^62")]


def read_plan(
    table: Mapping[str, Any], parameters: Sequence[Parameter], repeats: int, seed: int, load: Callable[[str], bytes]
) -> Plan:
    """Read `[[axis]]`, `[design]` and `[list]` of a sweep, whose rows are repeated for each of so many sources."""
    known = {parameter.name: parameter for parameter in parameters}
    listed: dict[str, list[tuple[Axis, np.ndarray]]] = {}
    drawn: list[Axis] = []
    entries = table.get("axis", [])
    if not isinstance(entries, list) or not all(isinstance(each, dict) for each in entries):
        raise DataError("axis: expected tables [[axis]], found something else; double the brackets.")
    for k, entry in enumerate(entries):
        axis, values = _axis(entry, f"axis[{k}]", known)
        if values is None:
            drawn.append(axis)
        else:
            label = entry.get("zip")
            listed.setdefault(f"{k}" if label is None else f"zip {label}", []).append((axis, values))
    groups: list[Listed | Drawn] = []
    for label, members in listed.items():
        lengths = {len(values) for _, values in members}
        if len(lengths) > 1:
            raise DataError(
                f"axis.zip: the axes of {label[4:]!r} have {' and '.join(map(str, sorted(lengths)))} values; zipped "
                "axes need as many each."
            )
        groups.append(Listed(tuple(axis for axis, _ in members), np.stack([values for _, values in members])))
    if "list" in table:
        groups.append(_list(table["list"], known, load))
    design = table.get("design")
    if drawn:
        if not isinstance(design, dict):
            raise DataError("design: expected how axes without a count are drawn; add [design] with method and rows.")
        how = typed(design, _Design, "design")
        groups.append(Drawn(tuple(drawn), how.method, how.rows, seed))
    elif design is not None:
        raise DataError("design: expected axes to draw, found none; give axes low and high without a count.")
    names = [axis.parameter for group in groups for axis in group.axes]
    for name in names:
        if names.count(name) > 1:
            raise DataError(f"axis.parameter: {name} is varied twice; keep one of the two.")
    if not groups and repeats == 1:
        raise DataError("axis: expected at least one axis, found none; add [[axis]].")
    if math.prod(len(group) for group in groups) * repeats > _MOST_ROWS:
        raise DataError("axis: these are more rows than can be counted; leave out some.")
    return Plan(tuple(groups), repeats)


def _axis(entry: Mapping[str, Any], place: str, known: Mapping[str, Parameter]) -> tuple[Axis, np.ndarray | None]:
    table = typed(entry, _Axis, place)
    name, relative = table.parameter, table.relative
    if name not in known:
        close = get_close_matches(name, [*known], n=3, cutoff=0.4)
        meant = f"did you mean {' or '.join(close)}?" if close else f"use one of {', '.join(known)}."
        raise DataError(f"{place}.parameter: there is no parameter {shown(name)}; {meant}")
    parameter = known[name]
    if not relative and math.isnan(parameter.nominal):
        raise DataError(
            f"{place}.parameter: {parameter.name} is an array, varied relative to itself; add relative = true."
        )
    factor = _factor(table.unit, "1" if relative else parameter.unit, f"{place}.unit", name)
    way, values = _values(entry, table, place, factor, parameter)
    check_plain(parameter, values if way == "listed" else None, relative, place)
    if relative and math.isfinite(parameter.nominal):
        # Factors of single numbers become values at once; only those of arrays stay factors.
        relative, nominal = False, parameter.nominal
        if nominal == 0:
            raise DataError(f"{place}.relative: {parameter.name} is 0, which no factor changes; give values.")
        if nominal < 0 and way == "log":
            raise DataError(f"axis.relative: a logarithmic axis needs a positive parameter, found {nominal:g}.")
        values = values * (np.array([nominal, abs(nominal)]) if way == "normal" else nominal)
        values = np.sort(values) if way in ("uniform", "log") else values
    below, above = values < parameter.lower, values > parameter.upper
    outside = np.all(below | above) if way == "listed" else way != "normal" and (np.all(below) or np.all(above))
    if outside and not relative:
        raise DataError(
            f"{place}: all values lie outside the bounds of {name}, {parameter.range_words}; correct them."
        )
    if way == "listed":
        return Axis(name, relative), values
    return Axis(name, relative, way, *values.tolist()), None


def _values(
    entry: Mapping[str, Any], table: _Axis, place: str, factor: float, parameter: Parameter
) -> tuple[str, np.ndarray]:
    """Values that are `listed`, also by a grid, or the distribution to draw from with its two numbers."""
    ways = [way for way in ("values", "low", "mean") if way in entry]
    if len(ways) != 1:
        raise DataError(
            f"{place}: expected one of values, low and high, or mean and sd, found {' and '.join(ways) or 'none'}."
        )
    for key in entry:
        if key not in ("parameter", "unit", "relative", *_WAYS[ways[0]]):
            raise DataError(f"{place}.{key}: an axis with {ways[0]} has no {key}; leave out one of the two.")
    if parameter.words and ways[0] != "values":
        raise DataError(
            f"{place}.{ways[0]}: {parameter.name} is a choice of words, which are listed; give values, some of "
            f"{', '.join(parameter.words)}."
        )
    if ways[0] == "low" and "zip" in entry and "count" not in entry:
        raise DataError(f"{place}.zip: an axis that is drawn is not zipped; add count, or leave out zip.")
    if ways[0] == "values":
        values = table.values
        if not isinstance(values, list):
            kind = "words" if parameter.words else "numbers"
            raise DataError(f"{place}.values: expected a list of {kind}, found {shown(values)}.")
        if not values:
            raise DataError(f"{place}.values: the axis is empty; give at least one value.")
        if parameter.words:
            words = parameter.words
            return "listed", np.array([float(words.index(one_of(words, x, f"{place}.values"))) for x in values])
        return "listed", factor * np.array([number(value, f"{place}.values") for value in values])
    keys = ("mean", "sd") if ways[0] == "mean" else ("low", "high")
    low, high = both = np.array([number(entry.get(key), f"{place}.{key}") * factor for key in keys])
    if ways[0] == "mean":
        if not high > 0:
            raise DataError(f"{place}.sd: expected a standard deviation above 0, found {high:g}; correct it.")
        return "normal", both
    log, count = table.spacing == "log", table.count
    if not low <= high or (log and not low > 0):
        above = " above 0" if log else ""
        raise DataError(f"{place}: expected low{above} and no higher than high, found {low:g} and {high:g}.")
    if count is None:
        return "log" if log else "uniform", both
    if count < 1:
        raise DataError(f"{place}.count: the axis is empty: expected a number of 1 or more, found {shown(count)}.")
    if count > _LONGEST:
        raise DataError(
            f"{place}.count: expected up to {_LONGEST:,} values, found more; leave out count and add [design]."
        )
    return "listed", np.geomspace(low, high, count) if log else np.linspace(low, high, count)


def _factor(unit: str | None, wanted: str, place: str, name: str) -> float:
    """What takes a unit to the parameter's own."""
    if unit is None or unit == wanted:
        return 1.0
    found, own = _UNIT.fullmatch(unit.replace("µ", "u").replace("μ", "u")), _UNIT.fullmatch(wanted)
    if found is None or own is None or found[2] != own[2]:
        raise DataError(f"{place}: {name} is in {wanted}, found {shown(unit)}; convert the values.")
    return float(10.0 ** (_PREFIXES[found[1]] - _PREFIXES[own[1]]))


def _list(entry: Any, known: Mapping[str, Parameter], load: Callable[[str], bytes]) -> Listed:
    if not isinstance(entry, dict) or set(entry) != {"file"} or not isinstance(entry["file"], str):
        raise DataError("list: expected the one key file, the name of a CSV with a column per parameter.")
    name = entry["file"]
    reader = csv.reader(io.StringIO(load(name).decode("utf-8-sig", errors="replace"), newline=""))
    try:
        lines = [(reader.line_num, cells) for cells in reader if any(cell.strip() for cell in cells)]
    except csv.Error as error:
        raise DataError(f"{name}, line {reader.line_num}: expected CSV ({error}); correct it.") from None
    if len(lines) < 2:
        raise DataError(f"{name}: the list is empty: expected a header and at least one row.")
    columns = [known.get(cell.strip()) for cell in lines.pop(0)[1]]
    if None in columns:
        # What stands in a file that is no list is not ours to show.
        raise DataError(
            f"{name}: cell {columns.index(None) + 1} of its header is no parameter; use some of {', '.join(known)}."
        )
    parameters = [column for column in columns if column is not None]
    for parameter in parameters:
        if math.isnan(parameter.nominal):
            raise DataError(f"{name}: {parameter.name} is an array; vary it by [[axis]] with relative = true.")
    rows = []
    kind = "values" if any(parameter.words for parameter in parameters) else "numbers"
    for line, cells in lines:
        place, row = f"{name}, line {line}", [math.nan]
        if len(cells) == len(parameters):
            row = [_cell(cell, parameter, place) for cell, parameter in zip(cells, parameters, strict=True)]
        if any(map(math.isnan, row)):
            raise DataError(
                f"{place}: expected {len(parameters)} {kind}, found {shown(', '.join(cells))}; correct it."
            )
        rows.append(row)
    table = np.array(rows).T
    if not np.all(np.isfinite(table)):
        raise DataError(f"{name}: expected finite numbers, found others; correct them.")
    for parameter, values in zip(parameters, table, strict=True):
        check_plain(parameter, values, False, name)
    return Listed(tuple(Axis(parameter.name) for parameter in parameters), table)


def _cell(cell: str, parameter: Parameter, place: str) -> float:
    """The number of a cell, or of its word; NaN where it is none."""
    if parameter.words:
        return float(parameter.words.index(one_of(parameter.words, cell.strip(), place)))
    try:
        return float(cell)
    except ValueError:
        return math.nan
