"""Time stamps: as seconds after the first."""

import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fits.io._quantity import FloatArray

_ISO = re.compile(
    r"(\d{4}-\d\d-\d\d[T ]\d\d:\d\d(:\d\d([.,]\d+)?)?|\d{8}T\d{4}(\d\d([.,]\d+)?)?) ?(Z|[+-]\d\d(:?\d\d)?)?"
)
# A time of day behind a date of any kind or none; what has no hours has a fraction, as spreadsheets write it.
_DAY = re.compile(
    r"(?P<date>[\d./-]{6,10}[ T]+)?(?:(?P<hour>\d{1,2}):(?=\d\d:)|(?=\d\d:\d\d[.,]))"
    r"(?P<minute>[0-5]\d):(?P<second>[0-5]\d(?:[.,]\d+)?)(?: ?(?P<half>[AaPp])[Mm])?"
)


def seconds(times: NDArray[Any]) -> FloatArray:
    """Times of the clock, or durations, as seconds after the first, shape (n,); a missing one is NaN."""
    fine = times.astype(f"{times.dtype.kind}8[ns]")
    count = fine - fine[np.argmin(np.isnat(fine))]
    return np.where(np.isnat(count), np.nan, count.astype(np.int64) / 1e9)


def clock_s(cells: list[str]) -> FloatArray:
    """Seconds after the first of some time stamps, shape (n,); a ValueError says which is none."""
    if _ISO.fullmatch(cells[0]):
        import pandas as pd

        stamps = pd.to_datetime(
            [cell.strip().replace(",", ".") for cell in cells], format="ISO8601", utc=True, errors="coerce"
        )
        if stamps.isna().any():
            _refuse(cells[int(np.argmax(stamps.isna()))])
        return seconds(stamps.tz_localize(None).to_numpy())
    found = [_DAY.fullmatch(cell.strip()) or _refuse(cell) for cell in cells]
    if len({each["date"] for each in found}) > 1:
        # Which of its numbers is the day is not known.
        raise ValueError("dates that change are read in the form 2026-11-25 only")
    time_s = np.array([_of_day_s(each) for each in found])
    # The clock begins again at midnight, and without hours at each of them.
    turn_s = 3600.0 if found[0]["hour"] is None else 86400.0
    turns = np.cumsum(np.diff(time_s, prepend=time_s[0]) < -turn_s / 2)
    return np.round((time_s - time_s[0] + turn_s * turns) * 1e9) / 1e9


def _of_day_s(time: re.Match[str]) -> float:
    """Time of a day in s."""
    hour, half = int(time["hour"] or 0), (time["half"] or "").lower()
    hour = hour % 12 + 12 * (half == "p") if half else hour
    return 3600.0 * hour + 60.0 * float(time["minute"]) + float(time["second"].replace(",", "."))


def _refuse(cell: str) -> re.Match[str]:
    raise ValueError(f"'{cell[:30]}'")


def is_clock(cell: str) -> bool:
    """Whether a cell is an ISO 8601 time stamp of date and time, or a time of day."""
    return (_ISO.fullmatch(cell) or _DAY.fullmatch(cell)) is not None
