"""A picture of an error budget."""

import os
from pathlib import Path
from typing import Any

from fits.io._printable import plain
from fits.machining._budget import Budget
from fits.plots._sensitivity import AXIS_SIGNS, UNIT_SIGNS
from fits.plots._style import DARK, WIDE_in, figure, label, legend, save

_PARTS = {"driving": "0.3", "machining": "0.65", "measuring": "0.95"}


def plot_budget(found: Budget, folder: str | os.PathLike[str]) -> list[Path]:
    """Draw the parts of the worst case of each axis in percent of its stroke, and the root sum of squares.

    `budget.png` is written into an existing folder, at 200 dots per inch; a `DataError` says if it cannot be.
    """
    axes = list(found.axes.values())
    places = range(len(axes))
    picture = figure(WIDE_in, 0.9 + 0.34 * len(axes))
    bars = picture.subplots()
    ends = [0.0] * len(axes)
    parts = [(abs(axis.driving), axis.machining_worst_case, axis.measuring or 0.0) for axis in axes]
    for (part, color), sizes in zip(_PARTS.items(), zip(*parts, strict=True), strict=True):
        widths = [100 * size / axis.stroke for size, axis in zip(sizes, axes, strict=True)]
        bars.barh(places, widths, 0.62, ends, color=color, edgecolor=DARK, linewidth=0.4, label=f"{part}, largest")
        ends = [end + width for end, width in zip(ends, widths, strict=True)]
    squares = [100 * axis.root_sum_square / axis.stroke for axis in axes]
    mark: dict[str, Any] = {"markersize": 4, "color": "1.0", "markeredgecolor": "0.0", "markeredgewidth": 0.8}
    bars.plot(squares, places, "D", label="root sum of squares of all", **mark)
    for place, axis in enumerate(axes):
        unit = UNIT_SIGNS[axis.output_unit]
        words = f"{plain(axis.worst_case, 3)} {unit} of {plain(axis.stroke)} {unit}"
        words += "" if axis.measuring is not None else ", sensor unknown"
        bars.annotate(words, (ends[place], place), (4, 0), textcoords="offset points", va="center", fontsize=7)
    bars.set_xlim(0, 1.35 * max(ends))
    bars.set_ylim(len(axes) - 0.4, -0.6)
    bars.set_yticks(places, [AXIS_SIGNS.get(axis.axis, axis.axis) for axis in axes])
    bars.tick_params(axis="y", length=0)
    label(bars, x="error (% of the stroke)")
    legend(picture, [bars])
    return [save(picture, Path(folder) / "budget.png")]
