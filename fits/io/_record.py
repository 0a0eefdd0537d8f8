"""One measured run, or a reference to follow: read-only arrays in s, V and um."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fits.io._errors import DataError
from fits.io._printable import printable
from fits.io._quantity import FloatArray
from fits.io._summary import AbstractSummary


def read_only(name: str, values: ArrayLike) -> FloatArray:
    """Numbers that nobody can change, of any shape; a `DataError` refuses what is none."""
    try:
        found = np.asarray(values)
        if found.dtype.kind == "c":
            raise DataError(f"{name}: expected real numbers, found complex ones; give the real part if it is meant")
        array = np.asarray(found, dtype=np.float64)
    except DataError:
        raise
    except (TypeError, ValueError):
        raise DataError(f"{name}: expected an array of numbers, found something else; give numbers alone") from None
    if array.flags.writeable:
        array = array.copy()  # the caller's own array stays writeable
        array.flags.writeable = False
    return array


@dataclass(frozen=True, eq=False, repr=False)
class Record(AbstractSummary):
    """One run of one rig, `n` samples long.

    Sample times in s increase strictly, in steps that may be uneven; commanded voltages are in V, measured
    displacements in um, or None for a voltage programme, shape (n,) each. `extra` holds all other numeric columns by
    name, each of shape (n,), such as ``temperature_degC``; `source` is the name of the file, without its folder, and
    `warnings` say what looked odd when it was read, one sentence each; what cannot be printed of them is kept as
    codes. By `charged_V` the driver of the rig was ahead of the first command when the record began, and
    `before_V` are the extremes that its hysteresis remembered then, oldest first, as far as they are known. Samples
    are marked in `lost`, shape (n,), whose displacement was not measured; none as long as nobody looked for them. A
    `DataError` says that the arrays are not one-dimensional or differ in length, that one of the three holds what is
    no finite number, or that times do not increase.
    """

    time_s: FloatArray
    voltage_V: FloatArray
    displacement_um: FloatArray | None
    extra: Mapping[str, FloatArray] = field(default_factory=dict)
    source: str = ""
    warnings: tuple[str, ...] = ()
    charged_V: float = 0.0
    before_V: tuple[float, ...] = ()
    lost: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, dtype=bool))

    def __post_init__(self) -> None:
        extra = {name: read_only(name, values) for name, values in self.extra.items()}
        _settle(self, ("time_s", "voltage_V", "displacement_um"), extra, " as time_s")
        object.__setattr__(self, "extra", MappingProxyType(extra))
        if self.lost.any() and self.lost.shape != (len(self),):
            raise DataError(f"lost has shape {self.lost.shape}, expected ({len(self)},) as time_s.")
        object.__setattr__(self, "lost", self.lost.copy() if self.lost.any() else np.zeros(len(self), dtype=bool))
        self.lost.flags.writeable = False

    def __len__(self) -> int:
        return self.time_s.size

    def summary(self) -> str:
        """Say how many samples there are, at which rate, their ranges with units, and what looked odd."""
        return _summary(self, {"displacement_um": self.displacement_um, **self.extra})

    @property
    def duration_s(self) -> float:
        """Time from the first sample to the last, in s."""
        return float(self.time_s[-1] - self.time_s[0])

    def __getitem__(self, samples: slice) -> "Record":
        """Return the samples of a slice, as a record; time keeps running from the original start."""
        if not isinstance(samples, slice) or (samples.step or 1) < 1:
            raise TypeError("A record is sliced forwards, as in record[100:200].")
        displacement = None if self.displacement_um is None else self.displacement_um[samples]
        extra = {name: values[samples] for name, values in self.extra.items()}
        data = self.time_s[samples], self.voltage_V[samples], displacement, extra, self.source, self.warnings
        return Record(*data, lost=self.lost[samples])

    def __reduce__(self) -> tuple[Any, ...]:
        # A MappingProxyType cannot be pickled, and records travel to worker processes.
        values = {name: getattr(self, name) for name in self.__dataclass_fields__}
        return Record, tuple((values | {"extra": dict(self.extra)}).values())


@dataclass(frozen=True, eq=False, repr=False)
class Reference(AbstractSummary):
    """A displacement wanted over time, `n` samples long.

    Times in s increase strictly; displacements are in um as the sensor would read them, shape (n,). For the others,
    and the ValueError, see `Record`.
    """

    time_s: FloatArray
    displacement_um: FloatArray
    source: str = ""
    warnings: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        _settle(self, ("time_s", "displacement_um"))

    def __len__(self) -> int:
        return self.time_s.size

    def summary(self) -> str:
        """Say how many samples there are, at which rate, their range with its unit, and what looked odd."""
        return _summary(self, {"displacement_um": self.displacement_um})


def _summary(record: "Record | Reference", columns: Mapping[str, FloatArray | None]) -> str:
    if not len(record):
        return f"{record.source or 'record'}: no samples"
    steps_s = np.diff(record.time_s)
    rate = f", {1 / np.median(steps_s):.6g} Hz" if len(steps_s) else ""
    rate += " in the median" if len(steps_s) and np.ptp(steps_s) > 0.01 * np.median(steps_s) else ""
    lines = [f"{record.source or 'record'}: {len(record)} samples in {np.ptp(record.time_s):.6g} s{rate}"]
    if isinstance(record, Record):
        columns = {"voltage_V": record.voltage_V, **columns}
    known = {name: values for name, values in columns.items() if values is not None}
    lines += [f"{name:20} {values.min():.6g} to {values.max():.6g}" for name, values in known.items()]
    return "\n".join([*lines, *(f"Note: {warning}" for warning in record.warnings)])


def _settle(
    record: Record | Reference, names: Sequence[str], extra: Mapping[str, FloatArray] | None = None, like: str = ""
) -> None:
    """Make arrays read-only and texts printable; what no model could be fitted to, or follow, is refused."""
    given = {name: getattr(record, name) for name in names}
    arrays = {name: read_only(name, values) for name, values in given.items() if values is not None}
    size = arrays["time_s"].size
    for name, array in (arrays | dict(extra or {})).items():
        if array.shape != (size,):
            raise DataError(f"{name} has shape {array.shape}, expected ({size},){like}.")
    for name, array in arrays.items():
        _refuse_odd(record.source, name, array)
        object.__setattr__(record, name, array)
    # Names of files may hold what no report, page or picture can.
    object.__setattr__(record, "source", printable(record.source))
    object.__setattr__(record, "warnings", tuple(map(printable, record.warnings)))


def _refuse_odd(source: str, name: str, array: FloatArray) -> None:
    """Refuse what no model could be fitted to, or follow."""
    place = f"{printable(source)}: " if source else ""
    odd = np.flatnonzero(~np.isfinite(array))
    if len(odd):
        raise DataError(
            f"{place}{name}[{odd[0]}]: expected a finite number, found {array[odd[0]]} ({len(odd)} such in all); "
            "leave these samples out"
        )
    if name == "time_s" and np.any(np.diff(array) <= 0):
        at = int(np.argmax(np.diff(array) <= 0)) + 1
        raise DataError(
            f"{place}time_s[{at}]: expected a time after {array[at - 1]:.9g} s, found {array[at]:.9g} s; sort the "
            "samples, and keep one of each time"
        )


def refuse_repeats(records: Sequence[Record]) -> None:
    """Refuse, in a `DataError`, records that are given twice: they would count twice, or be held out in vain."""
    for k, one in enumerate(records):
        for other in records[:k]:
            pairs = ((getattr(each, name) for each in (one, other)) for name in ("voltage_V", "displacement_um"))
            if one.displacement_um is not None and all(np.array_equal(*pair) for pair in pairs):
                raise DataError(f"{other.source} and {one.source} hold the same samples: give each run once")
