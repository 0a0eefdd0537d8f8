"""What a sweep's folder holds: how far it is, figures of its outputs, the best rows, and pictures."""

import math
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from fits._atomic import atomic_path
from fits._errors import DataError
from fits._plot_style import figure, label, verbatim
from fits.sweeps._about import about_of
from fits.sweeps._extra import need
from fits.sweeps._store import LEDGER, RESULTS
from fits.sweeps._types import DONE, FAILED

SCHEMA = "microid.sweep.summary/1"
_CELLS = 12
# Axes are logarithmic where values span more than this factor, and most lie near its lower end.
_DECADE = 10.0
# More lines than this do not show.
_LINES = 400
_WIDE_in, _HIGH_in = 7.09, 2.6


def open_sweep(folder: str | os.PathLike[str]) -> Any:
    """Open the results of a sweep, finished or not.

    Parameters
    ----------
    folder
        What the sweep was given by `--out`.

    Returns
    -------
    xarray.Dataset
        Along `row`; swept parameters are coordinates. Rows that are not there yet are NaN with a status of 0.

    Raises
    ------
    DataError
        If the folder holds no sweep or a broken one, or xarray and zarr are not installed.
    """
    about_of(folder)
    need("zarr")
    xarray = need("xarray")
    with _readable(folder):
        found = xarray.open_zarr(os.path.join(folder, RESULTS), chunks=None, consolidated=True)
        return found.assign_coords(row=np.arange(found.sizes["row"]))


@contextmanager
def _readable(folder: str | os.PathLike[str]) -> Iterator[None]:
    """Turn what decoders say of a broken file into one sentence."""
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
    """Sum up a sweep as JSON values.

    Parameters
    ----------
    folder
        Of the sweep.
    by, largest
        Output by which rows are ranked, the first by default, and whether large is good.
    """
    about, data = about_of(folder), open_sweep(folder)
    with _readable(folder):
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
    return [{"row": int(row)} | {name: _plain(data[name].values[row]) for name in names} for row in order]


def _plain(value: Any) -> float | str:
    return value if isinstance(value, str) else float(value)


def describe(summary: dict[str, Any]) -> str:
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


def plot_sweep(folder: str | os.PathLike[str], out: Path, by: str | None = None) -> list[Path]:
    """Draw heat maps of an output over pairs of parameters, and parallel coordinates; the files come back."""
    about, data = about_of(folder), open_sweep(folder)
    with _readable(folder):
        return _plots(folder, about, data, out, by)


def _plots(folder: str | os.PathLike[str], about: dict[str, Any], data: Any, out: Path, by: str | None) -> list[Path]:
    done = data["status"].values == DONE
    by = by or summarise(folder)["best"]["by"]
    names = about["parameters"]
    if by is None or not names:
        return []
    # What has no finite number, such as the settling time of a loop that does not settle, has no place in a mean.
    done &= np.isfinite(data[by].values)
    if done.sum() < 2:
        return []
    values = data[by].values[done]
    swept, words = {}, {}
    for name in names:
        found = data[name].values[done]
        if found.dtype.kind != "f":
            words[name], found = np.unique(found.astype(str), return_inverse=True)
        swept[name] = found
    made = [_parallel(out / "parallel.svg", swept, words, by, values)]
    pairs = [(one, other) for k, one in enumerate(names) for other in names[k + 1 :]][:6]
    made += [_heat(out / f"heat_{k}.svg", swept, words, pair, by, values) for k, pair in enumerate(pairs)]
    return made


def _parallel(
    path: Path, swept: dict[str, np.ndarray], words: dict[str, np.ndarray], by: str, values: np.ndarray
) -> Path:
    every = max(1, -(-len(values) // _LINES))
    columns = np.stack([*swept.values(), values], axis=1)[::every]
    low, high = columns.min(axis=0), columns.max(axis=0)
    scaled = (columns - low) / np.where(high > low, high - low, 1)
    picture = figure(_WIDE_in, _HIGH_in)
    axes = picture.add_subplot()
    colours = np.argsort(np.argsort(columns[:, -1])) / max(1, len(columns) - 1)
    for line, colour in zip(scaled, colours, strict=True):
        axes.plot(line, color=(colour, 0.25, 1 - colour), linewidth=0.4, alpha=0.6)
    ranges = {name: f"{a:.3g} to {b:.3g}" for name, a, b in zip([*swept, by], low, high, strict=True)}
    ranges |= {name: verbatim(", ".join(each)) for name, each in words.items()}
    axes.set_xticks(range(len(ranges)), [f"{verbatim(name)}\n{each}" for name, each in ranges.items()], fontsize=6)
    axes.set_yticks([])
    label(axes)
    return _saved(picture, path)


def _heat(
    path: Path,
    swept: dict[str, np.ndarray],
    words: dict[str, np.ndarray],
    pair: tuple[str, str],
    by: str,
    values: np.ndarray,
) -> Path:
    # Words are 0, 1, 2 and so on.
    logs = [name not in words and _logarithmic(swept[name]) for name in pair]
    x, y = (np.log10(swept[name]) if log else swept[name] for name, log in zip(pair, logs, strict=True))
    edges = [_edges(x), _edges(y)]
    count, *_ = np.histogram2d(x, y, bins=edges)
    total, *_ = np.histogram2d(x, y, bins=edges, weights=values)
    with np.errstate(invalid="ignore"):
        mean = np.where(count > 0, total / np.maximum(count, 1), math.nan)
    picture = figure(_WIDE_in / 2, _HIGH_in)
    axes = picture.add_subplot()
    corners = [10**ends if log else ends for ends, log in zip(edges, logs, strict=True)]
    drawn = axes.pcolormesh(*corners, mean.T, cmap="viridis")
    axes.set(xscale="log" if logs[0] else "linear", yscale="log" if logs[1] else "linear")
    picture.colorbar(drawn, label=f"mean {verbatim(by)}")
    label(axes, *map(verbatim, pair))
    for axis, name in zip((axes.xaxis, axes.yaxis), pair, strict=True):
        if name in words:
            axis.set_ticks(range(len(words[name])), [verbatim(word, 24) for word in words[name]])
    return _saved(picture, path)


def _logarithmic(found: np.ndarray) -> bool:
    """Whether values lie evenly by their logarithms rather than by themselves."""
    low, middle, high = float(found.min()), float(np.median(np.unique(found))), float(found.max())
    return low > 0 and high > _DECADE * low and middle < (low + high) / 3


def _edges(found: np.ndarray) -> np.ndarray:
    """Edges of cells around values, one cell for each where there are few."""
    distinct = np.unique(found)
    if not 1 < len(distinct) <= _CELLS:
        return np.histogram_bin_edges(found, min(_CELLS, len(distinct)))
    middles = (distinct[1:] + distinct[:-1]) / 2
    return np.concatenate([2 * distinct[:1] - middles[:1], middles, 2 * distinct[-1:] - middles[-1:]])


def _saved(picture: Any, path: Path) -> Path:
    with atomic_path(path) as unfinished:
        picture.savefig(unfinished)
    return path
