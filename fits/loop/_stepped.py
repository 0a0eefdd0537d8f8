"""A record in steps: whether its clock is even, and what its command does between samples, in NumPy."""

import numpy as np

from fits.io._errors import DataError
from fits.io._record import Record

# A hundred arrays of so many values are 8 GB.
_MOST_STEPS = 10_000_000
# Intervals behind a record: cubics through samples look two of them ahead, one part after another.
_MORE = 4


def refuse_many_steps(record: Record, stride: int) -> None:
    """Refuse, in a `DataError`, what would not fit into the memory."""
    if stride * len(record) > _MOST_STEPS:
        raise DataError(
            f"{record.source}: expected at most {_MOST_STEPS:,} steps, found {len(record):,} samples of {stride} "
            "substeps each; split the record, or use a model of fewer substeps"
        )


def even_interval_s(time_s: np.ndarray) -> float | None:
    """The one interval between instants, `(n,)`, that were taken by an even clock; None where it was not even.

    So near to those of an even clock, times were rounded when they were written.
    """
    step = float(time_s[-1] - time_s[0]) / max(len(time_s) - 1, 1)
    off = np.max(np.abs(time_s - time_s[0] - step * np.arange(len(time_s))))
    return step if off <= 1e-3 * step else None


def intervals(time_s: np.ndarray) -> np.ndarray:
    """Intervals between times, `(n - 1,)`, or `(1,)` where they differ by rounding of the largest time alone."""
    each = np.diff(time_s)
    mean = float(time_s[-1] - time_s[0]) / max(len(each), 1) or 1.0
    rounding = 4 * np.finfo(float).eps * max(abs(time_s[0]), abs(time_s[-1]))
    return np.array([mean]) if np.all(np.abs(each - mean) <= rounding) else each


def stepped(record: Record, steps: int, hold: str, as_run: bool) -> tuple[np.ndarray, np.ndarray]:
    """Divide the intervals of a record: these in s, `(m,)`, or `(1,)` where they are even, and the command in V.

    The latter, `(m + 1,)`, runs in lines, `first`, or stays until the next sample, `zero`. `as_run`, as a fit takes a
    record, a clock that is even but for rounding is even, and the command stays for some more intervals: then it is
    known what bends at the last sample.
    """
    refuse_many_steps(record, steps)
    step_s = even_interval_s(record.time_s) if as_run else None
    each_s = intervals(record.time_s) if step_s is None else np.array([step_s or 1.0])
    command_V = record.voltage_V
    if as_run:
        command_V = np.append(command_V, np.repeat(command_V[-1:], _MORE))
        each_s = each_s if len(each_s) == 1 else np.append(each_s, np.full(_MORE, each_s.mean()))
    share = np.arange(steps) / steps if hold == "first" else np.zeros(steps)
    finer = (command_V[:-1, None] + np.diff(command_V)[:, None] * share).ravel()
    return (each_s if len(each_s) == 1 else np.repeat(each_s, steps)) / steps, np.append(finer, command_V[-1:])
