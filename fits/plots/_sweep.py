"""Pictures of a sweep: heat maps of an output over pairs of parameters, and parallel coordinates."""

import math
import os
from pathlib import Path
from typing import Any

import numpy as np

from fits.io._atomic import atomic_path
from fits.plots._style import figure, label, verbatim
from fits.sweeps._show import open_sweep, readable, summarise
from fits.sweeps._store import about_of
from fits.sweeps._types import DONE

_CELLS = 12
# Axes are logarithmic where values span more than this factor, and most lie near its lower end.
_DECADE = 10.0
# More lines than this do not show.
_LINES = 400
_WIDE_in, _HIGH_in = 7.09, 2.6


def plot_sweep(folder: str | os.PathLike[str], out: Path, by: str | None = None) -> list[Path]:
    """Draw heat maps of an output over pairs of parameters, and parallel coordinates; the files come back."""
    about, data = about_of(folder), open_sweep(folder)
    with readable(folder):
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
