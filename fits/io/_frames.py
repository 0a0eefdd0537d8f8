"""Tables of other libraries."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from fits.io._table import ArrayTable, gathered


def of_frame(path: str, frame: Any, units: Mapping[str, str] | None = None) -> ArrayTable:
    """Columns of a `DataFrame`, its index among them if it has a name or holds times."""
    index = frame.index
    if index.name is not None or index.nlevels > 1 or index.dtype.kind in "mM":
        frame = frame.reset_index(names=None if index.nlevels > 1 else [index.name or "time"])
    found = []
    for k, name in enumerate(frame.columns):
        column, words = frame.iloc[:, k], "_".join(map(str, name)) if isinstance(name, tuple) else str(name)
        if getattr(column.dtype, "tz", None) is not None:
            column = column.dt.tz_convert(None)
        values = column.to_numpy(np.float64, na_value=np.nan) if column.dtype.kind in "iuf" else column.to_numpy()
        found.append(((words,), values, (units or {}).get(words)))
    return gathered(path, "a table", found)
