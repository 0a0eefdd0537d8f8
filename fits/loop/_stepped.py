"""A record in steps: whether its clock is even, and what its command does between samples, in NumPy."""

import numpy as np

from fits.io._errors import DataError
from fits.io._record import Record

# A hundred arrays of so many values are 8 GB.
_MOST_STEPS = 10_000_000


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


def stepped(record: Record, steps: int, hold: str) -> tuple[np.ndarray, np.ndarray]:
    """Divide the intervals of a record, and one more in which its command stays: intervals and command.

    The command is `(n steps + 1,)` and runs in lines, `first`, or stays until the next sample, `zero`; intervals are
    `(n steps,)`, or `(1,)` where they are even. What bends at the last sample is known by what comes after it.
    """
    command_V, step_s = np.append(record.voltage_V, record.voltage_V[-1:]), even_interval_s(record.time_s)
    if hold == "zero":
        finer = np.append(np.repeat(command_V[:-1], steps), command_V[-1:])
    else:
        share = np.arange(steps) / steps
        finer = np.append((command_V[:-1, None] + np.diff(command_V)[:, None] * share).ravel(), command_V[-1:])
    if step_s is not None:
        return np.array([step_s / steps]), finer
    each = np.diff(record.time_s)
    return np.repeat(np.append(each, each.mean()) / steps, steps), finer
