"""The look of all pictures, set on the figures themselves: Matplotlib's own settings stay as the user has them."""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text

from fits._atomic import atomic_path

# One and two columns of a journal, 90 mm and 180 mm.
NARROW_in, WIDE_in = 3.54, 7.09
DARK, LIGHT = "0.1", "0.75"
MEASURED: dict[str, Any] = {"color": "0.65", "linewidth": 1.6}
MODEL: dict[str, Any] = {"color": "0.0", "linewidth": 0.7, "linestyle": (0, (4, 1.5))}
_FONT_pt = 8
_DPI = 200
# More points than this do not show at this size.
_POINTS = 6000


def figure(width_in: float, height_in: float) -> Figure:
    """Make an empty figure with a canvas of its own."""
    made = Figure(figsize=(width_in, height_in), layout="constrained")
    FigureCanvasAgg(made)
    return made


def label(axes: Axes, x: str, y: str) -> None:
    """Name the axes; the frame is open at the top and right."""
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    axes.spines[["top", "right"]].set_visible(False)


def thinned(values: np.ndarray) -> np.ndarray:
    """Choose samples that look like all of them: the extremes of even stretches, and the ends.

    Parameters
    ----------
    values
        Shape `(n,)`.

    Returns
    -------
    ndarray
        Increasing indices, at most some thousands.
    """
    n = len(values)
    if n <= _POINTS:
        return np.arange(n)
    stretches = np.array_split(np.arange(n), _POINTS // 2)
    extremes = [(s[np.argmin(values[s])], s[np.argmax(values[s])]) for s in stretches]
    return np.unique(np.concatenate([np.ravel(extremes), [0, n - 1]]))


def save(picture: Figure, path: Path) -> Path:
    """Write a figure, whole or not at all."""
    for axes in picture.axes:
        axes.tick_params(labelsize=_FONT_pt, width=0.6, length=2.5)
        for spine in axes.spines.values():
            spine.set_linewidth(0.6)
        legend = axes.get_legend()
        if legend is not None:
            legend.set_frame_on(False)
    for text in picture.findobj(Text):
        text.set_fontsize(min(_FONT_pt, text.get_fontsize()))
    with atomic_path(path) as unfinished:
        picture.savefig(unfinished, dpi=_DPI)
    return path
