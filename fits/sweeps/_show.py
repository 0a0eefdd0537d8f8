"""What a sweep's folder holds: how far it is, figures of its outputs, and the best rows."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from fits.io._errors import DataError
from fits.sweeps._packages import need
from fits.sweeps._store import LEDGER, RESULTS, about_of
from fits.sweeps._types import DONE, FAILED

SCHEMA = "microid.sweep.summary/1"


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
    except DataError:
        raise
    except (OSError, RuntimeError, ValueError, KeyError, TypeError) as error:
        why = " ".join(str(error).split()) or type(error).__name__
        raise DataError(
            f"{os.fspath(folder)}: {RESULTS} is missing or broken ({why[:200]}); run the sweep again with --resume, "
            "which computes again what is damaged."
        ) from None


def summarise(folder: str | os.PathLike[str], by: str | None = None, largest: bool = False) -> dict[str, Any]:
    """Sum up a sweep as JSON values; its rows are ranked by an output, the first by default."""
    about, data = about_of(folder), open_sweep(folder)
    with readable(folder):
        return _summary(folder, about, data, by, largest)


def _summary(
    folder: str | os.PathLike[str], about: dict[str, Any], data: Any, by: str | None, largest: bool
) -> dict[str, Any]:
    status = data["status"].values
    done = status == DONE
    noted = len(list((Path(folder) / LEDGER).glob("[0-9]*.json")))
    numbers = [name for name in about["outputs"] if data[name].dims == ("row",) and data[name].dtype.kind == "f"]
    if by is not None and by not in numbers:
        raise DataError(f"--best: there is no output {by!r}; choose one of {', '.join(numbers)}.")
    by = by or (numbers[0] if numbers else None)
    reasons: dict[str, int] = {}
    for reason in data["reason"].values[status == FAILED]:
        kind = str(reason).partition(" = ")[0]
        reasons[kind] = reasons.get(kind, 0) + 1
    return {
        "schema": SCHEMA,
        "kind": about["kind"],
        "rows": about["rows"],
        "done": int(done.sum()),
        "failed": int((status == FAILED).sum()),
        "left": int(about["rows"] - np.sum(status > 0)),
        "chunks": about["chunks"],
        "chunks_done": noted,
        "reasons": dict(sorted(reasons.items(), key=lambda item: -item[1])[:10]),
        "outputs": {name: _figures(data[name].values[done], data[name].attrs.get("units", "1")) for name in numbers},
        "best": {"by": by, "largest": largest, "rows": _best(data, about, done, by, largest)},
        "versions": about["versions"],
    }


def _figures(values: np.ndarray, unit: str) -> dict[str, Any]:
    values = values[np.isfinite(values)]
    if not len(values):
        return {"unit": unit, "count": 0}
    low, middle, high = np.percentile(values, (5, 50, 95)).tolist()
    return {
        "unit": unit,
        "count": len(values),
        "min": float(values.min()),
        "p5": low,
        "median": middle,
        "p95": high,
        "max": float(values.max()),
        "mean": float(values.mean()),
        "sd": float(values.std()),
    }


def _best(data: Any, about: dict[str, Any], done: np.ndarray, by: str | None, largest: bool) -> list[dict[str, Any]]:
    if by is None:
        return []
    values = data[by].values
    there = np.flatnonzero(done & np.isfinite(values))
    order = there[np.argsort(-values[there] if largest else values[there], kind="stable")[:5]]
    names = [*about["parameters"], by]
    rows = [{name: data[name].values[row] for name in names} for row in order]
    plain = [{name: x if isinstance(x, str) else float(x) for name, x in row.items()} for row in rows]
    return [{"row": int(row)} | values for row, values in zip(order, plain, strict=True)]


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
        lines += [
            f"{name:28} " + " ".join(f"{each[key]:10.4g}" for key in ("min", "p5", "median", "p95", "max"))
            for name, each in filled.items()
        ]
    best = summary["best"]
    if best["rows"]:
        lines += ["", f"{'largest' if best['largest'] else 'smallest'} {best['by']}"]
        for row in best["rows"]:
            place = ", ".join(f"{name} {_told(x)}" for name, x in row.items() if name not in ("row", best["by"]))
            lines.append(f"  row {row['row']}: {row[best['by']]:.6g} at {place}")
    return "\n".join(lines)


def _told(value: float | str) -> str:
    return value if isinstance(value, str) else f"{value:.5g}"
