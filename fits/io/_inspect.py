"""What a file holds: its channels, what they are probably used for, and how to have it read so."""

import math
import os
import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from fits.io._errors import AnyPath, DataError
from fits.io._open_table import open_table
from fits.io._plausible import likely_stroke
from fits.io._quantity import FloatArray, split_unit
from fits.io._read_csv import read_reference, read_table
from fits.io._table import Table, data_error
from fits.io._text_table import is_missing
from fits.io._units import (
    Source,
    known_quantity,
    known_unit,
    parse_columns,
    recognise,
    recognise_again,
    scale_of,
    unscaled_unit,
)

# Names by which rigs call the columns of a record, whole and in small letters; a minus is for readings of a command.
_LIKELY = {
    "time_s": r"t|x_value|sec|(time|elapsed|clock|zeit).*",
    "voltage_V": r"[uv]\d*|ch1|ao\d*|.*(volt|drive|cmd|command|dac|input|pzt|piezo|spannung).*",
    "displacement_um": r"[xyzdwh]\d*|ch2|ai\d*|.*(disp|pos|gauge|height|stroke|sensor|lvdt|interf|mirror|weg).*",
}
_MULTIPLES_OF_s = {"min": 60.0, "h": 3600.0}
# Whole numbers of such a size, without a unit, are what a converter gives.
_COUNTS = 10_000
_READING = r".*(monitor|meas|readback).*"
# A position that is asked for is a command.
_ASKED = r"(target|goal|demand|setpoint|set_point|soll).*"


@dataclass(frozen=True)
class Channel:
    """A column of a file: its number from 1, its name, its unit if it states one, and its range in that unit.

    `use` is the column of a record that it probably is, such as `voltage_V`, or empty, and `guessed` says that its
    name does not say so. The range is None where it holds no numbers; `problem` is the first other thing in it.
    """

    number: int
    name: str
    unit: str | None
    lowest: float | None
    highest: float | None
    use: str
    guessed: bool
    problem: str


@dataclass(frozen=True)
class Inspection:
    """What a file holds, what was odd when it was read so, and the command to use, or nothing where none is known.

    The rate in Hz is None where no time is known; `even` says whether steps of the time differ by less than 1 %.
    """

    path: str
    rows: int
    rate_Hz: float | None
    even: bool
    channels: tuple[Channel, ...]
    command: str
    remarks: tuple[str, ...]


@np.errstate(all="ignore")  # absurd magnitudes overflow here
def inspect_table(path: AnyPath) -> Inspection:
    """Look at a file that `read_table` reads, and guess what is what; errors are those of `open_table`."""
    table = open_table(path)
    found, problems = table.read(())
    # Where numbers are missing here and there, the others of the column still say what it is.
    holes = [name for name, (_, words) in problems.items() if is_missing(words)]
    for name in holes:
        left, kept = table.without_missing([name])
        if kept.mean() > 0.5:
            found |= {name: left.read(())[0].get(name, np.zeros(0))}
    found = {name: found[name] for name in table.names if len(found.get(name, ()))}
    if not found:
        first = next(iter(problems), None)
        place, words = problems.get(first or "", ("", "none"))
        what = f"expected columns of numbers, found {words}; name another file, or write numbers such as 1234.5"
        raise data_error(os.fspath(path), what, place, first)
    known, doubtful = dict[str, Source](), set[str]()
    for name in found:
        if spoken := recognise_again(name):
            doubtful |= {spoken[0].column} & known.keys()
            known.setdefault(spoken[0].column, Source(name, spoken[1]))
    sources = known | _guessed(table, found, known)
    interval_s, even = table.interval_s, table.interval_s is not None
    if "time_s" in sources:
        timed = sources["time_s"]
        steps_s = np.diff(known_quantity("time_s").convert(timed.scale * found[timed.column], timed.unit))
        if len(steps_s):
            interval_s = float(np.median(steps_s))
            even = bool(np.ptp(steps_s) < 0.01 * interval_s)
    uses = {source.column: column for column, source in sources.items()}
    channels = []
    for k, name in enumerate(table.names, 1):
        values, use = found.get(name), uses.get(name, "")
        low, high = (None, None) if values is None else (float(values.min()), float(values.max()))
        problem = ", ".join(problems[name][::-1]) if name in problems else ""
        unit = known_unit(name) or unscaled_unit(name)
        if use == "time_s" and sources[use].scale > 1:
            unit = split_unit(name)[1]
        channels.append(Channel(k, name, unit, low, high, use, bool(use) and use not in known, problem))
    pairs = [
        f"{column}={_spec(table, source)}"
        for column, source in sources.items()
        if column not in known.keys() - doubtful
    ]
    options = ["--columns", ",".join(pairs)] if pairs else []
    if any(source.column in holes for source in sources.values()):
        options += ["--missing", "drop"]
    # What is wrong with a time that is named is said when it is read.
    timeless = interval_s is None and not any(
        said[0].column == "time_s" for said in map(recognise, table.names) if said
    )
    if timeless:
        options += ["--sample-rate", "HZ"]
    still = "voltage_V" in sources and not np.ptp(found[sources["voltage_V"].column])
    command, remarks = _command(os.fspath(path), {*sources}, options, still), [table.remark]
    if timeless and command:
        remarks.append("no column is a time: write the rate of the samples in place of HZ")
    elif command and not (still or any(math.isnan(source.scale) for source in sources.values())):
        remarks += _remarks(path, ",".join(pairs), options, {*sources})
    remarks += _unknown_units(table, found, sources)
    rate_Hz = 1 / interval_s if interval_s and interval_s > 0 else None
    rows = max(map(len, found.values()), default=0)
    said = tuple(filter(None, dict.fromkeys(remarks)))
    return Inspection(os.fspath(path), rows, rate_Hz, even, tuple(channels), command, said)


def _guessed(table: Table, found: dict[str, FloatArray], known: dict[str, Source]) -> dict[str, Source]:
    """Columns of a record that names do not state: by their units, by how rigs call them, else in their order."""
    guessed: dict[str, Source] = {}
    free = [name for name in found if name not in {source.column for source in known.values()}]
    for column in ("time_s", "voltage_V", "displacement_um"):
        if column in known or (column == "time_s" and table.interval_s is not None):
            continue
        quantity = known_quantity(column)
        fit = [name for name in free if np.ptp(found[name]) > 0 and known_unit(name) in (None, *quantity.powers)]
        # What counts from sample to sample is a time only if it is called one, and nothing else.
        fit = [name for name in fit if np.any(np.diff(found[name]) != 1) or _score(name, "time_s") > 0]
        rising = [name for name in fit if np.all(np.diff(found[name]) > 0)]
        fit = rising if column == "time_s" else [name for name in fit if name not in rising] or fit
        if fit:
            best = max(fit, key=lambda name: _score(name, column))
            free.remove(best)
            scale = _scale(column, best, found[best])
            guessed[column] = Source(best, known_unit(best) or quantity.unit, scale=scale)
    moved, driven = guessed.get("displacement_um"), (known | guessed).get("voltage_V")
    if moved and driven and known_unit(moved.column) is None and moved.scale == 1:
        volts = known_quantity("voltage_V").convert(driven.scale * np.ptp(found[driven.column]), driven.unit)
        convert, stroke = known_quantity("displacement_um").convert, np.ptp(found[moved.column])
        strokes = {unit: convert(stroke, unit) for unit in ("um", "nm", "mm", "m")}
        unit = next((unit for unit, um in strokes.items() if likely_stroke(float(um / volts))), "um")
        guessed["displacement_um"] = Source(moved.column, unit)
    return guessed


def _scale(column: str, name: str, values: FloatArray) -> float:
    """What 1 in a column is, in the unit of its name or else of the record; NaN where only who measured knows."""
    multiple = _MULTIPLES_OF_s.get(split_unit(name)[1] or "") if column == "time_s" else None
    whole = column != "time_s" and known_unit(name) is None and bool(np.all(values == np.rint(values)))
    return math.nan if whole and np.abs(values).max() >= _COUNTS else multiple or scale_of(name)


def _unknown_units(table: Table, found: dict[str, FloatArray], sources: dict[str, Source]) -> Iterator[str]:
    """What has to be stated of columns without a unit, or in one that says nothing of V, um or s, such as %."""
    for source in sources.values():
        name, unit = source.column, unscaled_unit(source.column)
        example = f"write what 1 of it is in place of SCALE, as in [0.5 {source.unit}]"
        if math.isnan(source.scale) and unit:
            yield f"column '{name}' is in '{unit}': {example}"
        elif math.isnan(source.scale):
            yield f"column '{name}' states no unit, and is taken for counts, as its numbers are whole: {example}"
        elif known_unit(name) is None and source.scale == 1:
            yield (
                f"column '{name}' states no unit, and [{source.unit}] is guessed: correct it, or write what 1 of it "
                f"is, as in [0.5{source.unit}]"
            )
    taken = {source.column for source in sources.values()}
    free = [name for name in found if name not in taken and np.ptp(found[name]) > 0]
    if free and "voltage_V" in sources and "displacement_um" not in sources:
        best = Source(max(free, key=lambda name: _score(name, "displacement_um")), "um", scale=0.5)
        yield (
            "no displacement was found; if a column is a reading of one, say what 1 of it is, as in --columns "
            f"{shlex.quote(f'displacement_um={_spec(table, best)}')}"
        )


def _score(name: str, column: str) -> int:
    stem = "_".join(re.sub(r"\(\d+\)$", "", split_unit(name)[0]).lower().split())
    fits_names = {each for each, likely in _LIKELY.items() if re.fullmatch(likely, stem)}
    fits_names = {"voltage_V"} if re.fullmatch(_ASKED, stem) else fits_names
    fit = 2 if column in fits_names else -3 if fits_names else 0
    return 4 * (known_unit(name) is not None) + fit - (re.fullmatch(_READING, stem) is not None)


def _spec(table: Table, source: Source) -> str:
    """How `--columns` names a source: by its number where the name would not pass."""
    if set(source.column) & set(",=") or source.column != source.column.strip():
        return Source(f"{table.names.index(source.column) + 1}", source.unit, scale=source.scale).spec()
    return source.spec()


def _command(path: str, there: set[str], options: list[str], still: bool) -> str:
    """What to paste; a record under a voltage that is `still` is of the noise."""
    path = f"./{path}" if path.startswith("-") else path
    if "displacement_um" in there:
        words = ["compensate", "model.json", path, *options, "--out", "voltage.csv"]
        if "voltage_V" in there:
            words = ["fit", path, *options, "--out", "model.json"]
        if still:
            words = ["budget", "paper", "model.json", path, *options]
    elif "voltage_V" in there:
        words = ["simulate", "model.json", path, *options, "--out", "prediction.csv"]
    else:
        return ""
    return shlex.join(["microid", *words])


def _remarks(path: AnyPath, columns: str, options: list[str], there: set[str]) -> list[str]:
    """What is said when the file is read so."""
    missing = "drop" if "drop" in options else "refuse"
    try:
        if "voltage_V" not in there:
            return list(read_reference(path, parse_columns(columns), missing=missing).warnings)
        required = ("displacement_um",) if "displacement_um" in there else ()
        return list(read_table(path, parse_columns(columns), required, missing=missing).warnings)
    except DataError as error:
        return [str(error)]
