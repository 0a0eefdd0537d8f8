"""Names and units of columns: what a header means, and which source column serves which quantity."""

import math
import re
import shlex
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from difflib import SequenceMatcher, get_close_matches

from fits.io._errors import DataError
from fits.io._quantity import BRACKETS, LENGTH, TIME, VOLTAGE, Quantity, split_unit
from fits.io.columns import COLUMNS

QUANTITIES = (
    Quantity("time", "s", TIME),
    Quantity("voltage", "V", VOLTAGE),
    Quantity("displacement", "um", LENGTH),
    *(column.quantity for column in COLUMNS.values()),
)
_NUMBERED = re.compile(r"-?\d+ *(\[[^\[\]]*\])?")
# What 1 in a column is, such as 1.2V of a drive in %.
_SCALED = re.compile(r"(\d+\.?\d*(?:[eE][+-]?\d+)?) *([^\d\s].*)")
# What stands for such a number until who measured writes it.
_UNKNOWN = "SCALE "
# Units that say nothing of V, um or s: shares of a range, and what converters give.
_UNSCALED = {"%", "percent", "count", "counts", "cts", "lsb", "digit", "digits"}
# What a header that stands in a file before is given, so that it can be told from the first.
_AGAIN = re.compile(r" \d+$")
# Other names of a quantity.
_ALSO = {"timestamp": "time", "datetime": "time", "date_time": "time"}


# Canonical column to source column, or all in one text, as for the option.
Columns = Mapping[str, str | int] | str | None


@dataclass(frozen=True)
class Source:
    """Where a canonical column comes from: the source column, its unit, how many of these its 1 is, and its sign.

    How many is NaN where only who measured knows it.
    """

    column: str
    unit: str
    sign: int = 1
    scale: float = 1.0

    def spec(self, flip: bool = False, unit: str | None = None) -> str:
        """Write the right-hand side of a mapping that reads this column, optionally changed."""
        sign = -self.sign if flip else self.sign
        unit = unit or self.unit
        factor = "" if self.scale == 1 else _UNKNOWN if math.isnan(self.scale) else f"{self.scale:.17g}"
        stated = "" if split_unit(self.column)[1] == factor + unit else f"[{factor}{unit}]"
        return f"{'-' if sign < 0 else ''}{self.column}{stated}"


def recognise(name: str) -> tuple[Quantity, str] | None:
    """Quantity and unit of a header such as ``voltage_mV``, or None where either is unknown."""
    stem, unit = split_unit(name)
    plain = "_".join(stem.lower().split())
    plain = _ALSO.get(plain, plain)
    for quantity in QUANTITIES:
        if quantity.stem == plain and unit in quantity.powers:
            return quantity, str(unit)
    return None


def recognise_again(name: str) -> tuple[Quantity, str] | None:
    """The same of a header that may stand there twice, and then has its number behind it."""
    return recognise(_AGAIN.sub("", name))


def known_unit(name: str) -> str | None:
    """The unit that a name ends in, such as `um` of `x[µm]` or of `x_Micrometers`; None where it is no known one."""
    unit = split_unit(name)[1]
    return unit if any(unit in quantity.powers for quantity in QUANTITIES) else None


def is_unscaled(unit: str) -> bool:
    """Whether a unit is one of those that say nothing of V, um or s."""
    return unit.lower() in _UNSCALED


def unscaled_unit(name: str) -> str | None:
    """The unit that a name ends in, such as `%` or counts, where only who measured knows what 1 of it is; or None."""
    unit = split_unit(name)[1]
    stated = unit is not None and known_unit(name) is None
    return unit if stated and (is_unscaled(str(unit)) or BRACKETS.fullmatch(name)) else None


def scale_of(name: str) -> float:
    """How many V, um or s 1 in a column of that name is in its own unit, if its name does not say otherwise."""
    return math.nan if unscaled_unit(name) else 1.0


def pairs_of(columns: Columns) -> Mapping[str, str]:
    """Canonical column to source column, however they were given."""
    if isinstance(columns, str):
        return parse_columns(columns)
    return {name: str(source) for name, source in (columns or {}).items()}


def parse_columns(text: str) -> dict[str, str]:
    """Read pairs such as ``voltage_V=u1_V,displacement_um=-height[m]`` of ``--columns``, as `read_table` takes them.

    Numbers alone, such as ``1,4``, count columns from 1, and are those that are needed, in their order: they come
    back under the keys "1", "2" and so on. A `DataError` refuses a pair without ``=``, and an unknown or a repeated
    column.
    """
    parts = [part.strip() for part in text.split(",") if part.strip()]
    if parts and all(_NUMBERED.fullmatch(part) for part in parts):
        return {str(k): part for k, part in enumerate(parts, 1)}
    columns: dict[str, str] = {}
    for pair in parts:
        column, equals, source = (part.strip() for part in pair.partition("="))
        if not (column and equals and source):
            raise DataError(
                "--columns: expected pairs such as voltage_V=u1_V, or numbers alone, separated by commas, found "
                f"'{pair}'."
            )
        if column in columns:
            raise DataError(f"--columns: {column} is given twice; keep one.")
        known_quantity(column)
        columns[column] = source
    return columns


def known_quantity(column: str) -> Quantity:
    """Quantity of a canonical column; a `DataError` where there is none of that name."""
    known = {quantity.column: quantity for quantity in QUANTITIES}
    if column not in known:
        raise DataError(f"--columns: '{column}' is not a column of a record; name one of {', '.join(known)}.")
    return known[column]


def find_sources(
    names: Sequence[str], columns: Mapping[str, str], required: Collection[str], place: str, file: str = ""
) -> dict[str, Source]:
    """Choose the source column of every canonical column that the user's mapping or, failing that, the headers give.

    A `DataError`, which begins with the place, refuses missing required columns, duplicates, and wrong units; it
    names the command that looks into the `file`, if there is one.
    """
    if "1" in columns:
        columns = _in_order(columns, names, required, place)
    sources = {column: _mapped(column, text, names, place) for column, text in columns.items()}
    taken = {source.column for source in sources.values()}
    for name in names:
        found = recognise_again(name)
        if found is None or name in taken:
            continue
        column = found[0].column
        if column in columns:
            continue
        if column in sources:
            raise DataError(
                f"{place}, column '{name}': expected one column for {column}, found also '{sources[column].column}'; "
                f"choose one with --columns {shlex.quote(f'{column}={name}')}."
            )
        sources[column] = Source(name, found[1])
    missing = [column for column in required if column not in sources]
    if missing:
        raise DataError(_missing(missing, names, sources, place, file))
    return sources


def _in_order(
    columns: Mapping[str, str], names: Sequence[str], required: Collection[str], place: str
) -> dict[str, str]:
    """Numbers alone, given to the required columns in their order; the time may have been found by its header.

    Where a number is that of this time, there has to be one for each.
    """
    order = list(required)
    times = {str(k) for k, found in enumerate(map(recognise, names), 1) if found and found[0].column == "time_s"}
    named = {number.lstrip("-").partition("[")[0].strip() for number in columns.values()}
    if "time_s" in order and times and not times & named and len(columns) < len(order):
        order.remove("time_s")
    if len(columns) != len(order):
        more = "" if "time_s" not in order else ", or state --sample-rate where no column holds the time"
        raise DataError(
            f"{place}: expected by --columns {len(order)} numbers, for {', '.join(order)}, found {len(columns)}; "
            f"give one for each{more}."
        )
    return dict(zip(order, columns.values(), strict=True))


def _mapped(column: str, text: str, names: Sequence[str], place: str) -> Source:
    quantity = known_quantity(column)
    text = text.strip()
    sign, stated = 1, None
    # A header may itself begin with a minus or end with brackets, so the literal name is tried first.
    bracketed = BRACKETS.fullmatch(text)
    if text.startswith("-") and not {text, bracketed["stem"] if bracketed else text} & set(names):
        sign, text = -1, text[1:].strip()
    if text not in names:
        match = BRACKETS.fullmatch(text)
        if match:
            text, stated = match["stem"], split_unit(text)[1]
    numbered = text.isascii() and text.isdigit()
    if text not in names:
        # By its number, or without the unit that the file states elsewhere.
        same = [name for name in names if BRACKETS.fullmatch(name) and split_unit(name)[0] == text]
        at = int(text[:9]) if numbered else 0
        text = same[0] if len(same) == 1 else names[at - 1] if 1 <= at <= len(names) else text
    if text not in names:
        near = get_close_matches(text, names, 3, 0.5) or names
        raise DataError(
            f"{place}, column '{text}': expected by --columns {column}={text}, found no such column; "
            f"the nearest are {_listed(near)}."
        )
    unit = stated or split_unit(_AGAIN.sub("", text))[1] or (quantity.unit if numbered else None)
    scaled = _SCALED.fullmatch(unit or "")
    scale = float(scaled[1]) if scaled and scaled[2] in quantity.powers else 1.0
    unit = scaled[2] if scaled and scaled[2] in quantity.powers else unit
    if unit not in quantity.powers or not 0 < scale < math.inf:
        found = f"found unit '{unit}'" if unit else "found no unit"
        if scaled and scale != 1:
            found = f"found {scaled[0]} for 1 in the column"
        stated_too = math.nan if known_unit(text) else scale_of(text)
        option = shlex.quote(f"{column}={Source(text, quantity.unit, scale=stated_too).spec()}")
        if unit and unit.startswith(_UNKNOWN):
            example = shlex.quote(f"{column}={text}[0.5 {quantity.unit}]")
            raise DataError(
                f"{place}, column '{text}': expected what 1 in the column is in {quantity.unit}, found '{unit}'; "
                f"write a number in place of SCALE, as in --columns {example}."
            )
        raise DataError(
            f"{place}, column '{text}': expected a unit out of {', '.join(quantity.powers)} for {column}, {found}; "
            f"state it, or what 1 in the column is, such as 0.5{quantity.unit}, in brackets: --columns {option}."
        )
    return Source(text, str(unit), sign, scale)


def _missing(
    missing: Sequence[str], names: Sequence[str], sources: Mapping[str, Source], place: str, file: str
) -> str:
    message = f"{place}, column '{missing[0]}': expected this column, found {_listed(names)}; "
    # A mapping or a frame has no separators.
    if len(names) == 1 and file:
        return f"{message}separate the columns by commas, semicolons, tabs or spaces."
    taken = {source.column for source in sources.values()}
    free = [name for name in names if name not in taken]
    guesses = []
    for quantity in map(known_quantity, missing):
        # Of a name like the column's, in a unit of it if there is such a one.
        likely = [name for name in free if split_unit(name)[1] in quantity.powers]
        likely = likely or [name for name in free if split_unit(name)[1] is None] or free or ["NAME"]
        near = max(likely, key=lambda name: SequenceMatcher(None, quantity.column, name.lower()).ratio())
        free = [name for name in free if name != near]  # a column serves once
        stem, unit = split_unit(near)
        known = unit in quantity.powers
        # Of a unit that no name states only the numbers tell something, and those are not read yet.
        stated = str(unit) if known else quantity.unit if unscaled_unit(near) else "UNIT"
        guesses.append(f"{quantity.column}={Source(near, stated, scale=1.0 if known else scale_of(near)).spec()}")
        if unit and not known and stem.lower() in (quantity.stem, quantity.column.lower()):
            message += f"'{near}' has the unknown unit '{unit}' instead of one out of {', '.join(quantity.powers)}; "
    message += f"name what is missing, for instance --columns {shlex.quote(','.join(guesses))}"
    if file and any(guess.endswith("[UNIT]") for guess in guesses):
        message += f", or see what microid inspect {shlex.quote(file)} says"
    if ", line " in place and not any(recognise(name) for name in names):
        message += ", or put # before this line if it is not the header"
    return f"{message}."


def _listed(names: Sequence[str]) -> str:
    shown = ", ".join(f"'{name[:40]}'" for name in names[:12])
    return shown if len(names) <= 12 else f"{shown} and {len(names) - 12} more"
