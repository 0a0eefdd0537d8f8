"""From a file to a `Record`: what is read, what is refused and what is warned of."""

import os
import shlex
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from fits.io._errors import AnyPath, DataError
from fits.io._open_table import open_table
from fits.io._plausible import (
    SHORTEST_STEP_s,
    STROKE_PER_VOLT_MAX_um_per_V,
    STROKE_PER_VOLT_MIN_um_per_V,
    check_size,
    check_time,
    likely_stroke,
)
from fits.io._quantity import FloatArray
from fits.io._record import Record, Reference
from fits.io._table import Problem, Table
from fits.io._units import Columns, Source, find_sources, known_quantity, pairs_of, recognise, unscaled_unit

MIN_SAMPLES = 50


def read_table(
    source: AnyPath | Any,
    columns: Columns = None,
    required: Iterable[str] = ("time_s", "voltage_V", "displacement_um"),
    sample_rate_Hz: float | None = None,
    missing: str = "refuse",
) -> Record:
    """Read one run from a file of any format, or take it from a `DataFrame`, a `Dataset` or a mapping of arrays.

    Formats are those of `fits/io/formats`: text, LabVIEW, MATLAB, HDF5, NumPy, JSON, Parquet and TDMS. Of a text the
    separator (comma, semicolon, tab), a decimal comma, the encoding (UTF-8, UTF-16 with a byte-order mark, Latin-1)
    and gzip are recognised, and a line of units below the header, lines above it, and ISO 8601 time stamps; blank
    lines and those that begin with ``#`` or ``%`` are skipped. Headers such as ``voltage_mV`` are recognised by stem
    and suffix and converted to the canonical unit: times are in s, voltages in V and displacements in um, each of
    shape (n,), and all other numeric columns in `extra`. A `DataError` says in one sentence with file, line and
    column what was expected and what to do.

    Parameters
    ----------
    source
        Name of the file, or the object.
    columns
        Canonical column to source column, for example ``{"voltage_V": "u1_V", "displacement_um": "-height[m]"}``:
        the unit is the suffix of the source or stands in brackets, and a minus flips the sign. ``drive[1.2V]`` says
        what 1 in the column is, as in %. A source may also be the number of a column, from 1, whose unit is then the
        canonical one if none is stated. Or all of it as one text, as for the option `--columns`.
    required
        Canonical columns that must be there. Time and voltage always are; without ``displacement_um`` the file is
        a voltage programme, which may be short and may hold the voltage.
    sample_rate_Hz
        Rate of even samples, in Hz, which takes the place of a column of times.
    missing
        ``refuse`` rows in which a required number is missing or NaN, or ``drop`` them, with a warning.
    """
    required = tuple(dict.fromkeys(("time_s", "voltage_V", *required)))
    read = KnownColumns.read(source, columns, required, sample_rate_Hz=sample_rate_Hz, missing=missing)
    table, sources, arrays = read.table, read.sources, dict(read.arrays)
    time_s, voltage_V = arrays.pop("time_s"), arrays.pop("voltage_V")
    displacement_um = arrays.pop("displacement_um", None)
    if "displacement_um" in required:
        if time_s.size < MIN_SAMPLES:
            what = f"expected at least {MIN_SAMPLES} samples, found {time_s.size}; record longer or sample faster"
            raise table.error(what, time_s.size - 1)
        for name in ("voltage_V", "displacement_um"):
            array = read.found[sources[name].column]
            if array.min() == array.max():
                what = (
                    f"expected values that change, found {array[0]:.9g} in every one from here to "
                    f"{table.place(array.size - 1)}; choose another column with --columns, or check the wiring"
                )
                raise table.error(what, 0, sources[name].column)

    used = {*sources, *(source.column for source in sources.values())}
    extra = {name: array for name, array in read.found.items() if name not in used} | arrays
    warnings = [
        f"{table.path}, {place}, column '{name}': dropped, because {found} is not a number; correct the cell if "
        "the column matters."
        for name, (place, found) in read.problems.items()
    ]
    # Further columns serve for little, and may hold anything that has a square and a cube.
    for name in [name for name, array in extra.items() if np.abs(array).max() > 1e30]:
        del extra[name]
        warnings.append(
            f"{table.path}, column '{name}': dropped, because it holds numbers beyond 1e+30; correct them if the "
            "column matters."
        )
    with np.errstate(all="ignore"):  # absurd magnitudes overflow here, and then warn of nothing
        warnings += [*read.left_out, *read.odd_units(), *read.odd_gaps(), *read.odd_voltage()]
        if displacement_um is not None:
            warnings += [*read.odd_stroke(), *read.saturated()]
    return Record(time_s, voltage_V, displacement_um, extra, os.path.basename(table.path), tuple(warnings))


def read_runs(
    paths: Iterable[AnyPath],
    columns: Columns = None,
    sample_rate_Hz: float | None = None,
    missing: str = "refuse",
) -> tuple[Record, ...]:
    """Read several files as several runs of one rig; arguments and errors are those of `read_table`."""
    paths = [paths] if isinstance(paths, str | os.PathLike) else list(paths)
    if not paths:
        raise DataError("Expected at least one CSV file, found none; name the files of the runs.")
    return tuple(read_table(path, columns, sample_rate_Hz=sample_rate_Hz, missing=missing) for path in paths)


def read_reference(
    path: AnyPath,
    columns: Columns = None,
    sample_rate_Hz: float | None = None,
    missing: str = "refuse",
) -> Reference:
    """Read a displacement to follow: the columns `time_s` and `displacement_um`; see `read_table` for all else."""
    needed = ("time_s", "displacement_um")
    read = KnownColumns.read(path, columns, needed, (), sample_rate_Hz, missing)
    with np.errstate(all="ignore"):
        warnings = (*read.left_out, *read.odd_units(), *read.odd_gaps())
    source = os.path.basename(read.table.path)
    return Reference(read.arrays["time_s"], read.arrays["displacement_um"], source, warnings)


@dataclass(frozen=True)
class KnownColumns:
    """What a file holds: sources and arrays of shape (n,) by canonical column, and all that was found by header."""

    table: Table
    sources: Mapping[str, Source]
    arrays: Mapping[str, FloatArray]
    found: Mapping[str, FloatArray]
    problems: Mapping[str, Problem]
    left_out: tuple[str, ...] = ()

    @classmethod
    def read(
        cls,
        path: AnyPath | Any,
        columns: Columns,
        required: Sequence[str],
        more: Sequence[str] | None = None,
        sample_rate_Hz: float | None = None,
        missing: str = "refuse",
    ) -> "KnownColumns":
        """Read the required columns, and of all others, or of `more`, those that are there; see `read_table`."""
        if missing not in ("refuse", "drop"):
            raise DataError(f"missing: expected refuse or drop, found {missing!r}.")
        table, columns = open_table(path), pairs_of(columns)
        if not (table.headed or columns):
            what = (
                "expected a header such as time_s,voltage_V,displacement_um, found numbers; insert the header above "
                "this line, without # before it, or number the columns, as in --columns time_s=1,voltage_V=2"
            )
            raise table.error(what)
        interval_s = _interval_s(table, columns, sample_rate_Hz)
        needed = [name for name in required if name != "time_s" or interval_s is None]
        place = ", ".join(filter(None, (table.path, table.place())))
        file = os.fspath(path) if isinstance(path, str | os.PathLike) else ""
        sources = find_sources(table.names, columns, needed, place, file)
        unused = sources.pop("time_s", None) if interval_s is not None else None
        if more is not None:
            sources = {name: sources[name] for name in (*required, *more) if name in sources}
        strict = {source.column for source in sources.values()}
        left_out, kept = tuple(filter(None, [table.remark])), None
        if missing == "drop":
            table, kept = table.without_missing(strict)
            if not kept.all():
                rows = f"{np.sum(~kept)} of {kept.size} rows"
                left_out += (f"{table.path}: {rows} were left out, as a number that is needed is missing there.",)
        found, problems = table.read(strict)
        arrays = {}
        for name, source in sources.items():
            quantity = known_quantity(name)
            with np.errstate(over="ignore"):
                arrays[name] = quantity.convert(source.sign * source.scale * found[source.column], source.unit)
            check_size(table, source.column, arrays[name], quantity.unit, source.unit)
        if interval_s is None:
            check_time(table, sources["time_s"].column, arrays["time_s"])
        else:
            count = np.arange(len(next(iter(found.values())))) if kept is None else np.flatnonzero(kept)
            # A quotient by a whole rate is rounded once, as those are that a file would have.
            rate_Hz = sample_rate_Hz or round(1 / interval_s) or 1
            arrays["time_s"] = count / rate_Hz if 1 / rate_Hz == interval_s else count * interval_s
            if unused is not None and unused.column in found:
                left_out += _other_rate(table, unused, found[unused.column], rate_Hz)
        return cls(table, sources, arrays, found, problems, left_out)

    def place(self, column: str, row: int | None = None) -> str:
        """File, line and header of a canonical column, to begin a warning with."""
        line = "" if row is None else self.table.place(row)
        header = f"column '{self.sources[column].column}'" if column in self.sources else ""
        return ", ".join(filter(None, (self.table.path, line, header)))

    def odd_units(self) -> Iterator[str]:
        """Columns in % or counts that are read as if 1 of it were 1 V, um or s."""
        for name, source in self.sources.items():
            unit = unscaled_unit(source.column)
            if unit and source.scale == 1:
                scaled = f"{name}={Source(source.column, source.unit, source.sign, 0.5).spec()}"
                yield (
                    f"{self.place(name)}: it is in '{unit}', and 1 of it was read as 1 {source.unit}; if it is not, "
                    f"state what it is, as in --columns {shlex.quote(scaled)}."
                )

    def odd_gaps(self) -> Iterator[str]:
        """Few long steps in an otherwise even time base; uneven sampling is legal."""
        time_s = self.arrays["time_s"]
        if time_s.size < MIN_SAMPLES:
            return
        steps_s = np.diff(time_s)
        median_s = float(np.median(steps_s))
        if np.quantile(steps_s, 0.95, method="lower") > 2.0 * median_s:
            return
        gaps = np.flatnonzero(steps_s > 5.0 * median_s)
        if gaps.size:
            worst = int(np.argmax(steps_s))
            count = "a gap" if gaps.size == 1 else f"{gaps.size} gaps, the longest"
            yield (
                f"{self.place('time_s', worst + 1)}: {count} of {steps_s[worst]:.4g} s after {time_s[worst]:.9g} s, "
                f"where samples are otherwise {median_s:.4g} s apart; split the file there if the voltage moved "
                "meanwhile."
            )

    def odd_voltage(self) -> Iterator[str]:
        """A voltage that wiggles as a measured one does."""
        voltage_V, displacement_um = self.arrays["voltage_V"], self.arrays.get("displacement_um")
        turns_V = _reversals(voltage_V)
        share = turns_V.size / voltage_V.size
        if voltage_V.size < MIN_SAMPLES or share <= 0.2:
            return
        wiggle = float(np.median(np.abs(np.diff(turns_V)))) / float(np.ptp(voltage_V))
        # Larger swings between reversals, as a share of the range, are a commanded multisine or noise drive; smaller
        # ones are the last digit of a 14-bit converter, too small to matter.
        if not 1e-4 < wiggle < 0.05:
            return
        place = self.place("voltage_V")
        if displacement_um is not None and _reversals(displacement_um).size < turns_V.size / 4:
            yield (
                f"{place}: it is noisy while the displacement is smooth, so the two are probably swapped; exchange "
                f"them with {self.swap()}."
            )
        else:
            yield (
                f"{place}: it turns round at {share:.0%} of the samples, so it looks measured and each wiggle acts "
                "as a small hysteresis loop; choose the commanded voltage with --columns voltage_V=NAME."
            )

    def odd_stroke(self) -> Iterator[str]:
        """A stroke per volt that no piezo stage has, and one that falls as the voltage rises."""
        voltage_V, displacement_um = self.arrays["voltage_V"], self.arrays["displacement_um"]
        source, place = self.sources["displacement_um"], self.place("displacement_um")
        if np.ptp(voltage_V) == 0.0 or np.ptp(displacement_um) == 0.0:
            return
        ratio = float(np.ptp(displacement_um) / np.ptp(voltage_V))
        if not likely_stroke(ratio):
            likely = " or ".join(self.likely_slips(ratio))
            remedy = f"perhaps {likely}" if likely else "check the units and the columns"
            yield (
                f"{place}: the stroke per volt is {ratio:.3g} um/V, expected {STROKE_PER_VOLT_MIN_um_per_V:g} to "
                f"{STROKE_PER_VOLT_MAX_um_per_V:g} um/V; {remedy}."
            )
        if np.corrcoef(voltage_V, displacement_um)[0, 1] < -0.5:
            yield (
                f"{place}: the displacement falls as the voltage rises; flip its sign with "
                f"--columns displacement_um={source.spec(flip=True)} if the sensor faces the other way."
            )

    def saturated(self) -> Iterator[str]:
        """Readings that stand at one end, eight or more, while the voltage moves by 3 % of its range: no peak."""
        voltage_V, displacement_um = self.arrays["voltage_V"], self.arrays["displacement_um"]
        enough_V = 0.03 * float(np.ptp(voltage_V))
        for end, words in ((displacement_um.max(), "largest"), (displacement_um.min(), "smallest")):
            edges = np.flatnonzero(np.diff((displacement_um == end).astype(int), prepend=0, append=0))
            for first, stop in zip(edges[::2], edges[1::2], strict=True):
                moved = float(np.ptp(voltage_V[first:stop]))
                if stop - first >= 8 and moved > enough_V:
                    yield (
                        f"{self.place('displacement_um', int(first))}: {stop - first} readings in a row are the "
                        f"{words}, {end:.6g} um, while the voltage moves by {moved:.3g} V, so the sensor is at its "
                        "end there; leave these lines out, or measure with more range."
                    )
                    break

    def likely_slips(self, ratio_um_per_V: float) -> Iterator[str]:
        """Slips of a unit and swapped columns that would bring the stroke per volt between its limits."""
        for power in (-3, 3, -6, 6):
            if not likely_stroke(ratio_um_per_V * 10.0**power):
                continue
            for column, shift in (("displacement_um", power), ("voltage_V", -power)):
                quantity, source = known_quantity(column), self.sources[column]
                unit = quantity.shifted(source.unit, shift)
                if unit:
                    changed = f"{column}={source.spec(unit=unit)}"
                    yield f"the {quantity.stem} is in {unit} instead of {source.unit} (--columns {changed})"
            break
        if ratio_um_per_V and likely_stroke(1.0 / ratio_um_per_V):
            yield f"voltage and displacement are swapped ({self.swap()})"

    def swap(self) -> str:
        """The option that exchanges voltage and displacement."""
        voltage, displacement = self.sources["voltage_V"], self.sources["displacement_um"]
        return (
            f"--columns voltage_V={Source(displacement.column, 'V').spec()},"
            f"displacement_um={Source(voltage.column, 'um').spec()}"
        )


def _interval_s(table: Table, columns: Mapping[str, str], rate_Hz: float | None) -> float | None:
    """Interval of even samples, as stated, or as the file says where no column holds the time; else None."""
    if rate_Hz is not None:
        if "time_s" in columns:
            raise DataError("--sample-rate: --columns names the time already; leave one of them out.")
        if not 0 < rate_Hz <= 1 / SHORTEST_STEP_s:
            raise DataError(f"--sample-rate: expected a rate above 0 and up to 1e12 Hz, found {rate_Hz:g}.")
        return 1 / rate_Hz
    known = (found[0].column for found in map(recognise, table.names) if found)
    return None if "time_s" in columns or "time_s" in known else table.interval_s


def _other_rate(table: Table, source: Source, times: FloatArray, rate_Hz: float) -> tuple[str, ...]:
    """A remark where a column of times, shape (n,), has another rate than the one that is taken in its place."""
    steps_s = np.diff(known_quantity("time_s").convert(times, source.unit))
    median_s = float(np.median(steps_s)) if len(steps_s) else 0.0
    if median_s <= 0 or abs(median_s * rate_Hz - 1) < 0.01:
        return ()
    words = f"it holds times at {1 / median_s:.6g} Hz, and --sample-rate {rate_Hz:g} was taken instead"
    return (f"{table.path}, column '{source.column}': {words}; leave that out if the column is right.",)


def _reversals(values: FloatArray) -> FloatArray:
    """Values at which a signal turns round, shape (number of reversals,)."""
    moves = np.flatnonzero(np.diff(values))
    rising = values[moves + 1] > values[moves]
    return values[moves[1:][rising[1:] != rising[:-1]]]
