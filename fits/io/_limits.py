"""Limits of a rig: what its records have reached, what a user states, and whether a command stays inside."""

import math
import re
from collections.abc import Collection, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np

from fits.io._errors import DataError
from fits.io._record import Record

# Range of each quantity, by name: lowest and highest value.
Ranges = dict[str, tuple[float, float]]
RangeMap = Mapping[str, tuple[float, float]]

UNITS = {"voltage": "V", "slew": "V/s", "displacement": "um", "velocity": "um/s"}
UNITS |= {"acceleration": "um/s^2", "current": "A/F"}
"""Quantities that are limited, and their units. The driver's current is stated per farad of the piezo: it is the slew
of the voltage at the piezo, C dU/dt, and records of voltage and displacement do not tell C."""

# By how much of its range a predicted quantity may go beyond what the records reached.
MARGIN = 0.02

# These have a sign that means something; of the others the size is limited.
_TWO_SIDED = ("voltage", "displacement")
_PREFIXES = {"": 1.0, "k": 1e3, "m": 1e-3, "u": 1e-6, "n": 1e-9}
_NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
_RANGE = re.compile(rf"(?:({_NUMBER}):)?({_NUMBER})\s*([^\d\s.:].*)?")


@dataclass(frozen=True)
class Extreme:
    """What a command makes of a quantity, `low` to `high`, beside limits, which are infinite where there are none."""

    name: str
    low: float
    high: float
    lowest: float
    highest: float

    @property
    def unit(self) -> str:
        """Unit of all four."""
        return UNITS[self.name]

    @property
    def excess(self) -> float:
        """How far the worse side is beyond its limit; 0 or less where it is inside."""
        sizes = [abs(value) for value in (self.low, self.high, self.lowest, self.highest) if math.isfinite(value)]
        return max(self.high - self.highest, self.lowest - self.low) - 1e-9 * max(sizes, default=0.0)

    def __str__(self) -> str:
        """As in `displacement 0.1 to 38.2 um (limits 0 to 40 um)`."""
        return (
            f"{self.name} {self.low:.4g} to {self.high:.4g} {self.unit} "
            f"(limits {self.lowest:.4g} to {self.highest:.4g} {self.unit})"
        )


def parse_limits(texts: Iterable[str]) -> Ranges:
    """Read texts such as `displacement=0:40um` or, of a size, `slew=2kV/s`; a `DataError` refuses any others."""
    found: Ranges = {}
    for text in texts:
        name, _, words = text[:200].partition("=")
        name = name.strip()
        if name not in UNITS:
            raise DataError(f"--limit: expected one of {', '.join(UNITS)}, found {name!r}; write NAME=LOW:HIGH.")
        if name in found:
            raise DataError(f"--limit {name}: expected it once, found it twice; leave one out.")
        match = _RANGE.fullmatch(words.strip())
        example = f"{name}=0:100{UNITS[name]}" if name in _TWO_SIDED else f"{name}=100{UNITS[name]}"
        if match is None:
            raise DataError(f"--limit {name}: expected a range such as {example}, found {words!r}; write it so.")
        factor = _factor(name, (match[3] or "").strip())
        if match[1] is None and name in _TWO_SIDED:
            raise DataError(f"--limit {name}: expected two numbers such as {example}, found {words!r}.")
        high = float(match[2]) * factor
        low = -high if match[1] is None else float(match[1]) * factor
        if not (math.isfinite(low) and math.isfinite(high) and low < high):
            raise DataError(f"--limit {name}: expected the lower of two numbers first, found {words!r}; swap them.")
        found[name] = low, high
    return found


def _factor(name: str, unit: str) -> float:
    """What a stated unit is in that of the quantity."""
    expected = UNITS[name]
    plain = unit.replace("µ", "u").replace("μ", "u").replace("²", "^2").replace("s2", "s^2")
    if plain in ("", expected):
        return 1.0
    # The unit without a prefix, such as m/s of um/s, and what it is.
    base, own = (expected[1:], 1e6) if expected.startswith("um") else (expected, 1.0)
    prefix = plain.removesuffix(base)
    if plain.endswith(base) and prefix in _PREFIXES:
        return _PREFIXES[prefix] * own
    raise DataError(f"--limit {name}: expected the unit {expected} or a multiple of it, found {unit!r}; convert it.")


def measured_ranges(record: Record, offset_um: float = 0.0) -> Ranges:
    """What a record shows without a model: voltage, slew, and displacement less an offset."""
    ranges = {"voltage": record.voltage_V, "slew": np.append(np.diff(record.voltage_V) / np.diff(record.time_s), 0.0)}
    if record.displacement_um is not None:
        ranges["displacement"] = record.displacement_um - offset_um
    return {name: (float(np.min(values)), float(np.max(values))) for name, values in ranges.items()}


def reached_in(report: Mapping[str, Any]) -> Ranges:
    """What the runs of a model reached, by its file's `fit`, displacements as in the first run; or nothing."""
    listed, found, first_um = report.get("runs"), [], None
    for run in listed if isinstance(listed, list) else ():
        if isinstance(run, Mapping) and run.get("reached"):
            ranges, offset = ranges_of_json(run["reached"]), run.get("offset_um")
            offset_um = float(offset) if isinstance(offset, int | float) else 0.0
            first_um = offset_um if first_um is None else first_um
            if "displacement" in ranges:
                (low, high), shift_um = ranges["displacement"], first_um - offset_um
                ranges["displacement"] = low + shift_um, high + shift_um
            found.append(ranges)
    return joined(found)


def joined(ranges: Iterable[RangeMap]) -> Ranges:
    """The smallest ranges that hold all of several."""
    found: Ranges = {}
    for one in ranges:
        for name, (low, high) in one.items():
            before = found.get(name, (low, high))
            found[name] = min(low, before[0]), max(high, before[1])
    return found


def allowed(reached: RangeMap, stated: RangeMap, margin: float) -> Ranges:
    """Limits: what a user stated, or else what the records reached.

    Of what has no sign that matters, the larger size counts both ways. A predicted quantity may go by `margin` of its
    range beyond what was reached; the command may not. A `DataError` refuses a margin that is negative or not finite.
    """
    if not (math.isfinite(margin) and margin >= 0):
        raise DataError(f"margin: expected a share of the ranges reached, 0 or more, found {margin:g}.")
    found: Ranges = {}
    for name in UNITS:
        if name in stated:
            found[name] = stated[name]
        elif name in reached:
            low, high = reached[name]
            if name not in _TWO_SIDED:
                high = max(abs(low), abs(high))
                low = -high
            if name not in ("voltage", "slew"):  # which are the command itself, and not predicted
                more = margin * (high - low) * (1.0 if name in _TWO_SIDED else 0.5)
                low, high = low - more, high + more
            found[name] = low, high
    return found


def compared(predicted: RangeMap, limits: RangeMap) -> tuple[Extreme, ...]:
    """What is predicted beside its limits, for all that is limited."""
    both = [name for name in UNITS if name in predicted and name in limits]
    return tuple(Extreme(name, *predicted[name], *limits[name]) for name in both)


def beyond(extremes: Iterable[Extreme]) -> tuple[Extreme, ...]:
    """Those that leave their limits."""
    return tuple(one for one in extremes if one.excess > 0)


def check_command(
    source: str, predicted: RangeMap, reached: RangeMap, stated: RangeMap, margin: float, spared: Collection[str] = ()
) -> list[str]:
    """Refuse, in a `DataError`, a command that leaves what the rig has shown; remarks come back.

    It follows the reference `source`; `predicted` is what it is, and makes the rig do. For `reached`, `stated` and
    `margin` see `allowed`. Of the quantities `spared` a remark is made instead, unless their limit is stated.
    """
    for name in (name for name in stated if name not in predicted):
        raise DataError(f"--limit {name}: nothing says how large it becomes here; leave it out.")
    remarks = []
    if not reached:
        remarks.append(
            "the model file does not say what its runs reached, so that only the range of the voltage was checked; "
            "fit again, or state limits with --limit"
        )
    for one in beyond(compared(predicted, allowed(reached, stated, margin))):
        worst = one.high if one.high - one.highest >= one.lowest - one.low else one.low
        limit = one.highest if worst == one.high else one.lowest
        words = f"{source}: to follow it takes a {one.name} of {worst:.4g} {one.unit}, "
        if one.name in stated:
            raise DataError(
                f"{words}but --limit allows {limit:.4g} {one.unit}; slow it down, shrink it, or widen that."
            )
        words += f"where the runs that the model was fitted to reached {limit:.4g} {one.unit}"
        stated_so = f"state what the rig stands with {stated_as(one)}"
        if one.name not in spared:
            raise DataError(f"{words}; slow the reference down or shrink it, or {stated_so}.")
        remarks.append(f"{words}; {stated_so} to have it kept")
    return remarks


def stated_as(one: Extreme) -> str:
    """The option that would allow what is predicted, such as `--limit displacement=-1.2:43um`."""
    if one.name in _TWO_SIDED:
        low, high = -float(_above(-min(one.low, one.lowest))), _above(max(one.high, one.highest))
        return f"--limit {one.name}={low:.4g}:{high}{one.unit}"
    return f"--limit {one.name}={_above(max(-one.low, one.high))}{one.unit}"


def _above(value: float) -> str:
    """A number of three digits that is not smaller."""
    if value == 0:
        return "0"
    unit = 10.0 ** (math.floor(math.log10(abs(value))) - 2)
    return f"{math.ceil(value / unit - 1e-9) * unit:.4g}"


def ranges_json(ranges: RangeMap) -> dict[str, list[float]]:
    """Ranges as a model file keeps them, each under its name with the unit, as in `velocity_um_per_s`."""
    return {_key(name): [float(low), float(high)] for name, (low, high) in ranges.items()}


def ranges_of_json(content: object) -> Ranges:
    """Ranges from what `ranges_json` wrote; nothing where there is none, or it is not of that form."""
    if not isinstance(content, Mapping):
        return {}
    found: Ranges = {}
    for name in UNITS:
        with suppress(msgspec.ValidationError):
            found[name] = msgspec.convert(content.get(_key(name)), tuple[float, float])
    return found


def _key(name: str) -> str:
    return f"{name}_{UNITS[name].replace('/', '_per_').replace('^', '')}"
