"""What a sweep's folder holds: how far it is, figures of its outputs, and the best rows."""

import os
import re
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from fits.io._errors import DataError
from fits.sweeps._store import LEDGER, RESULTS, about_of, need
from fits.sweeps._types import DONE, FAILED

SCHEMA = "microid.sweep.summary/1"
_PERCENTILES = ("min", "p5", "median", "p95", "max")


def open_sweep(folder: str | os.PathLike[str]) -> Any:
    """Open the results of a sweep, finished or not, as an `xarray.Dataset` along `row`.

    Swept parameters are coordinates. Rows that are not there yet are NaN with a status of 0. A `DataError` says that
    the folder holds no sweep or a broken one, or that xarray and zarr are not installed.
    """
    about_of(folder)
    need("zarr")
    xarray = need("xarray")
    with readable(folder):
        found = xarray.open_zarr(os.path.join(folder, RESULTS), chunks=None, consolidated=True)
        return found.assign_coords(row=np.arange(found.sizes["row"]))


@contextmanager
def readable(folder: str | os.PathLike[str]) -> Iterator[None]:
    """Turn the errors of decoders of a broken file into a `DataError`."""
    try:
        yield
    except (OSError, RuntimeError, ValueError, KeyError, TypeError) as error:
        if isinstance(error, DataError):
            raise
        why = " ".join(str(error).split()) or type(error).__name__
        raise DataError(
            f"{os.fspath(folder)}: {RESULTS} is missing or broken ({why[:200]}); resume the sweep, "
            "which computes again what is damaged."
        ) from None


def summarise(folder: str | os.PathLike[str], by: str | None = None, largest: bool = False) -> dict[str, Any]:
    """Sum up a sweep as JSON values; its rows are ranked by an output, the first by default."""
    about, data = about_of(folder), open_sweep(folder)
    with readable(folder):
        status = data["status"].values
        done = status == DONE
        numbers = [name for name in about["outputs"] if data[name].dims == ("row",) and data[name].dtype.kind == "f"]
        if by is not None and by not in numbers:
            raise DataError(f"best: there is no output {by!r}; choose one of {', '.join(numbers)}.")
        by = by or (numbers[0] if numbers else None)
        # Rows that fail for one reason have another value each.
        kinds = Counter(
            re.sub(r" = \S+", "", str(reason), count=1) for reason in data["reason"].values[status == FAILED]
        )
        return {
            "schema": SCHEMA,
            "kind": about["kind"],
            "rows": about["rows"],
            "done": int(done.sum()),
            "failed": int((status == FAILED).sum()),
            "left": int(about["rows"] - np.sum(status > 0)),
            "chunks": about["chunks"],
            "chunks_done": len(list((Path(folder) / LEDGER).glob("[0-9]*.json"))),
            "reasons": dict(kinds.most_common(10)),
            "outputs": {
                name: _figures(data[name].values[done], data[name].attrs.get("units", "1")) for name in numbers
            },
            "best": {"by": by, "largest": largest, "rows": _best(data, about, done, by, largest)},
            "versions": about["versions"],
        }


def _figures(values: np.ndarray, unit: str) -> dict[str, Any]:
    values = values[np.isfinite(values)]
    found: dict[str, Any] = {"unit": unit, "count": len(values)}
    if len(values):
        percentiles = np.percentile(values, (0, 5, 50, 95, 100)).tolist()
        found |= dict(zip(_PERCENTILES, percentiles, strict=True))
        found |= {"mean": float(values.mean()), "sd": float(values.std())}
    return found


def _best(data: Any, about: dict[str, Any], done: np.ndarray, by: str | None, largest: bool) -> list[dict[str, Any]]:
    if by is None:
        return []
    values = data[by].values
    there = np.flatnonzero(done & np.isfinite(values))
    order = there[np.argsort(-values[there] if largest else values[there], kind="stable")[:5]]
    rows = []
    for row in order.tolist():
        found = {name: data[name].values[row] for name in (*about["parameters"], by)}
        rows.append({"row": row} | {name: x if isinstance(x, str) else float(x) for name, x in found.items()})
    return rows


def describe_sweep(summary: dict[str, Any]) -> str:
    """Put a summary into words."""
    lines = [
        f"{summary['kind']}: {summary['done']:,} of {summary['rows']:,} rows done, {summary['failed']:,} failed, "
        f"{summary['left']:,} left"
    ]
    lines += [f"  {count:,} rows: {reason}" for reason, count in summary["reasons"].items()]
    filled = {name: each for name, each in summary["outputs"].items() if each["count"]}
    if filled:
        lines += ["", f"{'output':28} {'min':>10} {'5 %':>10} {'median':>10} {'95 %':>10} {'max':>10}"]
        for name, each in filled.items():
            lines.append(f"{name:28} " + " ".join(f"{each[key]:10.4g}" for key in _PERCENTILES))
    best = summary["best"]
    if best["rows"]:
        lines += ["", f"{'largest' if best['largest'] else 'smallest'} {best['by']}"]
        for row in best["rows"]:
            swept = {name: x for name, x in row.items() if name not in ("row", best["by"])}
            place = ", ".join(f"{name} {x if isinstance(x, str) else f'{x:.5g}'}" for name, x in swept.items())
            lines.append(f"  row {row['row']}: {row[best['by']]:.6g} at {place}")
    return "\n".join(lines)
