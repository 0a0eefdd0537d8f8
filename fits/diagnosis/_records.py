"""Records as a diagnosis reads them: those that go on are one, and long ones are read in part, to bound memory."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from fits.io._record import Record
from fits.io.columns.path import PATH, gone_V

# Samples in all from which on memory is short, and that are diagnosed at once, in some 2 GB.
LONG, MOST = 20_000, 40_000
# Windows of a long record, at most, and cycles of the command that each of them has, at least.
_WINDOWS, _CYCLES = 4, 3.0
# Intervals are the same up to this part, and what goes on comes one of them after the last sample, up to that part.
_SAME, _NEXT = 0.01, 0.5
# Ends of the range that the command goes between in a cycle, as a part of it.
_END = 0.25


def joined(records: Sequence[Record]) -> tuple[Record, ...]:
    """Join each record to the one before where its time goes on from there: the stage knows no files."""
    found: list[Record] = []
    for record in records:
        if found and _goes_on(found[-1], record):
            found[-1] = _together(found[-1], record)
        else:
            found.append(record)
    return tuple(found)


def _goes_on(before: Record, record: Record) -> bool:
    """Whether a record begins one sampling interval after another ends, with the same columns."""
    if before.extra.keys() != record.extra.keys() or min(len(before), len(record)) < 2:
        return False
    interval_s, after_s = (float(np.median(np.diff(one.time_s))) for one in (before, record))
    gap_s = float(record.time_s[0] - before.time_s[-1])
    return abs(after_s / interval_s - 1) < _SAME and abs(gap_s / interval_s - 1) < _NEXT


def _together(before: Record, record: Record) -> Record:
    assert before.displacement_um is not None
    assert record.displacement_um is not None
    extra = {name: np.concatenate([values, record.extra[name]]) for name, values in before.extra.items()}
    return Record(
        np.concatenate([before.time_s, record.time_s]),
        np.concatenate([before.voltage_V, record.voltage_V]),
        np.concatenate([before.displacement_um, record.displacement_um]),
        extra,
        ", ".join(dict.fromkeys(one.source for one in (before, record) if one.source)),
        (*before.warnings, *record.warnings),
        lost=np.concatenate([before.lost, record.lost]),
    )


def excerpts(records: Sequence[Record], most: int = MOST) -> tuple[tuple[Record, ...], tuple[str, ...]]:
    """Reduce records to `most` samples or a few more, and say what was done: short ones stay as they are.

    Of long ones windows are cut out that are spread evenly over the record. Where not even one would hold a few
    cycles of the command, neighbours are averaged before.
    """
    sizes = np.sort([len(record) for record in records])
    left, share = most, most
    for k, size in enumerate(sizes):
        share = max(left // (len(sizes) - k), 1)
        if size > share:
            break
        left -= size
    else:
        return tuple(records), ()
    found: list[Record] = []
    said: list[str] = []
    for record in records:
        if len(record) <= share:
            found.append(record)
            continue
        # What lies between windows counts for whatever grows with the way.
        whole = replace(record, extra={PATH: gone_V(record.voltage_V), **record.extra})
        shorter = _averaged(whole, -(-round(min(_CYCLES * _cycle(record.voltage_V), len(record))) // share))
        windows = list(_windows(shorter, share))
        found += windows
        used, mean = sum(map(len, windows)), round(len(record) / len(shorter))
        means = f", means of {mean} each, so that faults of single samples are not seen" if mean > 1 else ""
        parts = f", in {len(windows)} windows spread over the record" if len(windows) > 1 else ""
        said.append(
            f"{record.source or 'a record'}: {len(record)} samples are more than a diagnosis holds at once; "
            f"{used} values were read of it{means}{parts}"
        )
    return tuple(found), tuple(said)


def _cycle(voltage_V: np.ndarray) -> float:
    """Samples in which the command goes once through most of its range and back, in the mean."""
    low_V, range_V = float(voltage_V.min()), float(np.ptp(voltage_V))
    end = np.sign((voltage_V > low_V + (1 - _END) * range_V).astype(int) - (voltage_V < low_V + _END * range_V))
    passed = int(np.count_nonzero(np.diff(end[end != 0])))
    return 2.0 * len(voltage_V) / max(passed, 1)


def _averaged(record: Record, count: int) -> Record:
    """The means of so many neighbours, as a record; what is left over at its end is left out."""
    if count == 1:
        return record

    def means(values: np.ndarray) -> np.ndarray:
        return np.mean(values[: len(values) // count * count].reshape(-1, count), axis=1)

    assert record.displacement_um is not None
    extra = {name: means(values) for name, values in record.extra.items()}
    data = means(record.time_s), means(record.voltage_V), means(record.displacement_um)
    return Record(*data, extra, record.source, record.warnings)


def _windows(record: Record, share: int) -> Iterator[Record]:
    """Windows of so many samples together, the first at the beginning of the record and the last at its end."""
    if len(record) <= share:
        yield record
        return
    count = int(np.clip(share / (_CYCLES * _cycle(record.voltage_V)), 1, _WINDOWS))
    size = share // count
    for first in np.linspace(0, len(record) - size, count).astype(int):
        window = record[first : first + size]
        yield replace(window, source=f"{record.source or 'record'} from {window.time_s[0]:.6g} s")
