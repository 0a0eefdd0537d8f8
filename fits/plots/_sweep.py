"""Pictures of a sweep: heat maps of an output over pairs of parameters, and parallel coordinates."""

import itertools
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from fits.io._errors import AnyPath
from fits.plots._style import WIDE_in, label, panels, save_all, verbatim
from fits.sweeps._show import open_sweep, readable, summarise
from fits.sweeps._store import about_of
from fits.sweeps._types import DONE

_CELLS = 12
_HIGH_in = 2.6


@dataclass(frozen=True)
class _Rows:
    """Swept parameters and the output that is drawn, of rows that are done; a word is its number in `words`."""

    swept: dict[str, np.ndarray]
    words: dict[str, np.ndarray]
    by: str
    values: np.ndarray


def plot_sweep(folder: AnyPath, out: AnyPath, by: str | None = None, *, form: str = "png") -> list[Path]:
    """Draw heat maps of an output over pairs of parameters, and parallel coordinates; the files come back.

    The form is `png` (200 dots per inch), `svg` or `pdf`.
    """
    names, data = about_of(folder)["parameters"], open_sweep(folder)
    with readable(folder):
        by = by or summarise(folder)["best"]["by"]
        if by is None or not names:
            return []
        # What has no finite number, such as the settling time of a loop that does not settle, has no place in a mean.
        done = (data["status"].values == DONE) & np.isfinite(data[by].values)
        if done.sum() < 2:
            return []
        rows = _Rows({}, {}, by, data[by].values[done])
        for name in names:
            found = data[name].values[done]
            if found.dtype.kind != "f":
                rows.words[name], found = np.unique(found.astype(str), return_inverse=True)
            rows.swept[name] = found
    pairs = list(itertools.combinations(names, 2))[:6]
    maps = {f"heat_{k}": _heat(rows, pair) for k, pair in enumerate(pairs)}
    return save_all({"parallel": _parallel(rows)} | maps, out, form)


def _parallel(rows: _Rows) -> Figure:
    every = max(1, -(-len(rows.values) // 400))  # more lines do not show
    columns = np.stack([*rows.swept.values(), rows.values], axis=1)[::every]
    low, high = columns.min(axis=0), columns.max(axis=0)
    scaled = (columns - low) / np.where(high > low, high - low, 1)
    picture, axes = panels(WIDE_in, _HIGH_in)
    colours = np.argsort(np.argsort(columns[:, -1])) / max(1, len(columns) - 1)
    for line, colour in zip(scaled, colours, strict=True):
        axes.plot(line, color=(colour, 0.25, 1 - colour), linewidth=0.4, alpha=0.6)
    ranges = {name: f"{a:.3g} to {b:.3g}" for name, a, b in zip([*rows.swept, rows.by], low, high, strict=True)}
    ranges |= {name: verbatim(", ".join(each)) for name, each in rows.words.items()}
    axes.set_xticks(range(len(ranges)), [f"{verbatim(name)}\n{each}" for name, each in ranges.items()], fontsize=6)
    axes.set_yticks([])
    label(axes)
    return picture


def _heat(rows: _Rows, pair: tuple[str, str]) -> Figure:
    logs = [name not in rows.words and _logarithmic(rows.swept[name]) for name in pair]
    x, y = (np.log10(rows.swept[name]) if log else rows.swept[name] for name, log in zip(pair, logs, strict=True))
    edges = [_edges(x), _edges(y)]
    count, *_ = np.histogram2d(x, y, bins=edges)
    total, *_ = np.histogram2d(x, y, bins=edges, weights=rows.values)
    with np.errstate(invalid="ignore"):
        mean = np.where(count > 0, total / np.maximum(count, 1), math.nan)
    picture, axes = panels(WIDE_in / 2, _HIGH_in)
    corners = [10**ends if log else ends for ends, log in zip(edges, logs, strict=True)]
    drawn = axes.pcolormesh(*corners, mean.T, cmap="viridis")
    axes.set(xscale="log" if logs[0] else "linear", yscale="log" if logs[1] else "linear")
    picture.colorbar(drawn, label=f"mean {verbatim(rows.by)}")
    label(axes, verbatim(pair[0]), verbatim(pair[1]))
    for axis, name in zip((axes.xaxis, axes.yaxis), pair, strict=True):
        if name in rows.words:
            axis.set_ticks(range(len(rows.words[name])), [verbatim(word, 24) for word in rows.words[name]])
    return picture


def _logarithmic(found: np.ndarray) -> bool:
    """Whether values lie evenly by their logarithms rather than by themselves."""
    low, middle, high = float(found.min()), float(np.median(np.unique(found))), float(found.max())
    return low > 0 and high > 10.0 * low and middle < (low + high) / 3


def _edges(found: np.ndarray) -> np.ndarray:
    """Edges of cells around values, one cell for each where there are few."""
    distinct = np.unique(found)
    if not 1 < len(distinct) <= _CELLS:
        return np.histogram_bin_edges(found, min(_CELLS, len(distinct)))
    middles = (distinct[1:] + distinct[:-1]) / 2
    return np.concatenate([2 * distinct[:1] - middles[:1], middles, 2 * distinct[-1:] - middles[-1:]])
