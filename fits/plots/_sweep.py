"""Pictures of a sweep: heat maps of an output over pairs of parameters, and parallel coordinates."""

import itertools
import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from fits.io._errors import AnyPath
from fits.plots._style import DARK, WIDE_in, label, legend, panels, save_all, verbatim
from fits.sweeps._show import open_sweep, readable, summarise
from fits.sweeps._store import about_of
from fits.sweeps._types import DONE, FAILED

_CELLS, _MOST_TICKS = 12, 8
_HIGH_in = 2.6
_FAILED = (0.8, 0.1, 0.1, 1.0)


@dataclass(frozen=True)
class _Rows:
    """Swept parameters and the output that is drawn, NaN where a row failed; a word is its number in `words`."""

    swept: dict[str, np.ndarray]
    words: dict[str, np.ndarray]
    by: str
    values: np.ndarray

    def logarithmic(self, name: str) -> bool:
        return name not in self.words and _logarithmic(self.swept[name])


def plot_sweep(folder: AnyPath, out: AnyPath, by: str | None = None, *, form: str = "png") -> list[Path]:
    """Draw heat maps of an output over pairs of parameters, and parallel coordinates; the files come back.

    Rows that failed are drawn as such. The form is `png` (200 dots per inch), `svg` or `pdf`.
    """
    names, data = about_of(folder)["parameters"], open_sweep(folder)
    with readable(folder):
        by = by or summarise(folder)["best"]["by"]
        if by is None or not names:
            return []
        failed, values = data["status"].values == FAILED, data[by].values
        # What has no finite number, such as the settling time of a loop that does not settle, has no place in a mean.
        done = (data["status"].values == DONE) & np.isfinite(values)
        if done.sum() < 2:
            return []
        shown = done | failed
        rows = _Rows({}, {}, by, np.where(done, values, math.nan)[shown])
        for name in names:
            found = data[name].values[shown]
            if found.dtype.kind != "f":
                rows.words[name], found = np.unique(found.astype(str), return_inverse=True)
            rows.swept[name] = found
    pairs = list(itertools.combinations(names, 2))[:6]
    maps = {f"heat_{k}": _heat(rows, pair) for k, pair in enumerate(pairs)}
    return save_all({"parallel": _parallel(rows)} | maps, out, form)


def _parallel(rows: _Rows) -> Figure:
    every = max(1, -(-len(rows.values) // 400))  # more lines do not show
    names, logs = [*rows.swept, rows.by], [*map(rows.logarithmic, rows.swept), False]
    shown = [np.log10(x) if log else x for x, log in zip([*rows.swept.values(), rows.values], logs, strict=True)]
    columns = np.stack(shown, axis=1)
    low, high = np.nanmin(columns, axis=0), np.nanmax(columns, axis=0)
    size = np.where(high > low, high - low, 1)
    scaled = ((columns - low) / size)[::every]
    picture, axes = panels(WIDE_in, _HIGH_in + 0.4)
    shades = ScalarMappable(Normalize(low[-1], high[-1]), "viridis")
    colours = np.where(np.isfinite(scaled[:, -1:]), shades.to_rgba(columns[::every, -1]), _FAILED)
    for line, colour in zip(scaled, colours, strict=True):
        axes.plot(line, color=colour, linewidth=0.4, alpha=0.6)
    if np.isnan(columns).any():
        axes.plot([], [], color=_FAILED, linewidth=0.8, label="failed")
        legend(picture, (axes,))
    box: dict[str, Any] = {"facecolor": "white", "alpha": 0.7, "linewidth": 0, "pad": 0.6}
    for k, name in enumerate(names):
        axes.axvline(k, color=DARK, linewidth=0.6)
        ticks = _ticks(columns[:, k])
        for tick in ticks if high[k] > low[k] else ticks[:1]:
            words = f"{10**tick if logs[k] else tick:.3g}"
            if name in rows.words:
                words = verbatim(rows.words[name][int(tick)], 24)
            beside = (k, (tick - low[k]) / size[k]), (-3 if k == len(names) - 1 else 3, 0)
            side = "right" if k == len(names) - 1 else "left"
            axes.annotate(words, *beside, textcoords="offset points", ha=side, va="center", fontsize=6, bbox=box)
        below = _wrapped(name, 110 // len(names))
        axes.text(k, -0.04, below, ha="center", va="top", fontsize=6, transform=axes.get_xaxis_transform())
    axes.set_axis_off()
    picture.colorbar(shades, ax=axes, label=verbatim(rows.by))
    return picture


def _ticks(found: np.ndarray) -> np.ndarray:
    """Where few values are, these; else five evenly from the lowest to the highest."""
    known = found[np.isfinite(found)]
    distinct = np.unique(known)
    return distinct if len(distinct) <= _MOST_TICKS else np.linspace(known.min(), known.max(), 5)


def _wrapped(name: str, most: int) -> str:
    """A name in lines of a few characters, broken behind its dots and underscores."""
    lines = [""]
    for part in re.findall(r"[^._]*[._]?", name):
        if lines[-1] and len(lines[-1]) + len(part) > most:
            lines.append("")
        lines[-1] += part
    return "\n".join(map(verbatim, lines))


def _heat(rows: _Rows, pair: tuple[str, str]) -> Figure:
    logs = [*map(rows.logarithmic, pair)]
    x, y = (np.log10(rows.swept[name]) if log else rows.swept[name] for name, log in zip(pair, logs, strict=True))
    edges, done = [_edges(x), _edges(y)], np.isfinite(rows.values)
    count, *_ = np.histogram2d(x[done], y[done], bins=edges)
    total, *_ = np.histogram2d(x[done], y[done], bins=edges, weights=rows.values[done])
    with np.errstate(invalid="ignore"):
        mean = np.where(count > 0, total / np.maximum(count, 1), math.nan)
    picture, axes = panels(WIDE_in / 2, _HIGH_in)
    corners = [10**ends if log else ends for ends, log in zip(edges, logs, strict=True)]
    # Without edges of their own, cells have white lines between them in SVG and PDF.
    drawn = axes.pcolormesh(*corners, mean.T, cmap="viridis", edgecolors="face", linewidth=0.3)
    if not done.all():
        there = (rows.swept[name][~done] for name in pair)
        # Whole at the rim, too.
        axes.plot(*there, "x", color=_FAILED, markersize=3, markeredgewidth=0.7, label="failed", clip_on=False)
        legend(picture, (axes,))
    axes.set(xscale="log" if logs[0] else "linear", yscale="log" if logs[1] else "linear")
    axes.set(xlim=corners[0][[0, -1]], ylim=corners[1][[0, -1]])
    empty = "white: no row" if (np.histogram2d(x, y, bins=edges)[0] == 0).any() else ""
    picture.colorbar(drawn, label=f"mean {verbatim(rows.by)}")
    label(axes, verbatim(pair[0]), verbatim(pair[1]), empty)
    for axis, name in zip((axes.xaxis, axes.yaxis), pair, strict=True):
        if name in rows.words:
            axis.set_ticks(range(len(rows.words[name])), [verbatim(word, 24) for word in rows.words[name]])
        elif len(few := np.unique(rows.swept[name])) <= _MOST_TICKS:
            # Cells reach beyond their values.
            axis.set_ticks(few, [f"{value:.3g}" for value in few])
            axis.set_ticks([], minor=True)
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
