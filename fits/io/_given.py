"""Runs as a user has them: records, tables of other libraries, or names of files."""

import os
from collections.abc import Iterable, Mapping
from dataclasses import replace
from numbers import Real
from typing import Any, TypeVar

import numpy as np

from fits.io._errors import DataError
from fits.io._in_python import read_reference, read_table
from fits.io._record import Record, Reference

# One run or an iterable of several: records, names of files, or what else `read_table` takes, such as a DataFrame.
AnyRuns = Any
_Given = TypeVar("_Given", Record, Record | Reference)


def records_given(given: AnyRuns, what: str = "run") -> tuple[Record, ...]:
    """One run or several as records of a measured displacement.

    A `DataError` says which cannot be read, has no samples, or was only commanded.
    """
    # Tables of pandas and of xarray are iterables of their columns, and one column is one of numbers.
    is_table = hasattr(given, "columns") or hasattr(given, "to_dataframe") or hasattr(given, "dtype")
    is_one = is_table or isinstance(given, Record | str | os.PathLike | Mapping) or not isinstance(given, Iterable)
    each: Iterable[Any] = (given,) if is_one else given
    read = (one if isinstance(one, Record) else read_table(one) for one in each)
    found = tuple(_with_samples(record, f"{what} {number}") for number, record in enumerate(read, 1))
    for record in found:
        if record.displacement_um is None:
            raise DataError(f"{record.source}: a displacement column is needed here")
    return found


def program_given(given: Any) -> Record:
    """A voltage program as a record: one, the name of a file, or what else `read_table` takes."""
    found = given if isinstance(given, Record) else read_table(given, required=("time_s", "voltage_V"))
    return _with_samples(found, "the program")


def reference_given(given: Any) -> Record | Reference:
    """A displacement to follow: a record or a reference, the name of a file, or what else `read_reference` takes."""
    return _with_samples(given if isinstance(given, Record | Reference) else read_reference(given), "the reference")


def _with_samples(given: _Given, name: str) -> _Given:
    """Refuse what holds no sample; what has no name gets one, so that sentences can speak of it."""
    if len(given.time_s) == 0:
        raise DataError(f"{given.source or name}: there are no samples; give a run that has some")
    return given if given.source else replace(given, source=name)


def holdout_given(holdout: float | AnyRuns) -> float | tuple[Record, ...]:
    """Fraction held out of every run, or runs that are held out as a whole; see `records_given`."""
    if isinstance(holdout, Real) or (isinstance(holdout, np.ndarray) and holdout.ndim == 0):
        return float(holdout)
    if isinstance(holdout, np.ndarray | list | tuple) and any(isinstance(one, Real) for one in holdout):
        raise DataError("holdout: expected one fraction, or runs, found a list of numbers; give one of these")
    return records_given(holdout, "held-out run")
