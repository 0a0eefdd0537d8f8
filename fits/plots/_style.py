"""The look of all pictures, set on the figures themselves: Matplotlib's own settings stay as the user has them."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.text import Text

from fits.io._atomic import atomic_path
from fits.io._errors import AnyPath
from fits.io._printable import printable

# One and two columns of a journal, 90 mm and 180 mm.
NARROW_in, WIDE_in = 3.54, 7.09
# Of a PNG.
DOTS_PER_in = 200
DARK, LIGHT = "0.1", "0.75"
MEASURED: dict[str, Any] = {"color": "0.65", "linewidth": 1.5}
MODEL: dict[str, Any] = {"color": "0.0", "linewidth": 0.5}
_FONT_pt = 8
# More points than this do not show at this size.
_POINTS = 6000


def figure(width_in: float, height_in: float, gap: float = 0.02) -> Figure:
    """Make an empty figure with a canvas of its own, and a gap between columns as a fraction of their width."""
    made = Figure(figsize=(width_in, height_in), layout=ConstrainedLayoutEngine(wspace=gap, compress=True))
    FigureCanvasAgg(made)
    return made


def panels(
    width_in: float, height_in: float, rows: int = 1, columns: int = 1, gap: float = 0.02, **layout: Any
) -> tuple[Figure, Any]:
    """Make a figure with rows and columns of axes; the further settings are those of `Figure.subplots`."""
    made = figure(width_in, height_in, gap)
    return made, made.subplots(rows, columns, **layout)


def label(axes: Axes, x: str = "", y: str = "", title: str = "", size_pt: float = 7) -> None:
    """Name the axes, and the panel at its left, where there is a name; the frame is open at the top and right."""
    axes.set_xlabel(x or axes.get_xlabel())
    axes.set_ylabel(y or axes.get_ylabel())
    if title:
        axes.set_title(title, loc="left", fontsize=size_pt)
    axes.spines[["top", "right"]].set_visible(False)


def verbatim(text: str, most: int = 60) -> str:
    """Let a text from outside, such as a file's name, be drawn as it is: `$` starts no formula, and it fits."""
    cut = text if len(text) <= most else f"…{text[1 - most :]}"
    return printable(cut).replace("$", r"\$")


def legend(picture: Figure, axes: Iterable[Axes]) -> None:
    """Explain the curves of some axes in one line above the picture, each name once."""
    found = [zip(*each.get_legend_handles_labels(), strict=True) for each in axes]
    curves = {name: handle for each in found for handle, name in each}
    place: dict[str, Any] = {"loc": "outside upper center", "ncols": len(curves)}
    drawn = picture.legend(curves.values(), curves.keys(), frameon=False, handlelength=1.8, **place)
    for handle in drawn.get_lines():
        # Dots that are many are small, and one alone would not show.
        handle.set_markersize(max(handle.get_markersize(), 2.5))


def thinned(values: np.ndarray, points: int = _POINTS) -> np.ndarray:
    """Choose samples that look like all, shape `(n,)`: the extremes of even stretches, and the ends.

    Increasing indices come back; of a stretch in which nothing is finite there are none.
    """
    n = len(values)
    if n <= points:
        return np.arange(n)
    chosen = [0, n - 1]
    for stretch in np.array_split(np.arange(n), max(points // 2, 1)):
        known = stretch[np.isfinite(values[stretch])]
        if known.size:
            chosen += [known[np.argmin(values[known])], known[np.argmax(values[known])]]
    return np.unique(chosen)


def curve(axes: Axes, x: np.ndarray, y: np.ndarray, name: str = "", **style: Any) -> None:
    """Draw what a curve of many samples, shape `(n,)`, looks like; values that are not known are NaN."""
    keep = thinned(np.nan_to_num(y))
    axes.plot(x[keep], y[keep], label=name, **style)


def dots(axes: Axes, x: np.ndarray, y: np.ndarray, name: str = "", color: str = DARK, size: float = 1.2) -> None:
    """Draw samples, shape `(n,)`, as dots of a size in points; of many some, evenly chosen."""
    every = -(-len(x) // _POINTS) or 1
    how: dict[str, Any] = {"color": color, "markersize": size, "markeredgewidth": 0, "rasterized": True}
    axes.plot(x[::every], y[::every], ".", label=name, **how)


def styled(picture: Figure) -> Figure:
    """Give a figure the lines and letters of all pictures."""
    for axes in picture.axes:
        axes.tick_params(labelsize=_FONT_pt, width=0.6, length=2.5)
        axes.spines[:].set_linewidth(0.6)
    for text in picture.findobj(Text):
        text.set_fontsize(min(_FONT_pt, text.get_fontsize()))
    return picture


def save_all(pictures: Mapping[str, Figure], folder: AnyPath, form: str) -> list[Path]:
    """Write figures by name into a folder, in a format: `png`, `svg` or `pdf`."""
    return [save(picture, Path(folder) / f"{name}.{form}") for name, picture in pictures.items()]


def save(picture: Figure, path: Path) -> Path:
    """Write a figure, whole or not at all."""
    styled(picture)
    with atomic_path(path) as unfinished:
        picture.savefig(unfinished, dpi=DOTS_PER_in)
    return path
