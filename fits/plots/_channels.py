"""The picture of what a file holds."""

from pathlib import Path

import numpy as np

from fits.io._errors import AnyPath
from fits.io._inspect import Inspection
from fits.io._open_table import open_table
from fits.plots._style import MODEL, WIDE_in, curve, label, panels, save_all, verbatim

# More panels than this are not looked at together.
_MOST = 12


def plot_channels(found: Inspection, folder: AnyPath, form: str = "png") -> list[Path]:
    """Draw the channels of a file that hold numbers, the first twelve of them, over its time or over its rows.

    What was found is from `inspect_table`, which opens the same file. `channels` is written into an existing
    folder, in the form `png` (200 dots per inch), `svg` or `pdf`; a `DataError` says if it cannot be.
    """
    values = open_table(found.path).read(())[0]
    time = next((each.name for each in found.channels if each.use == "time_s"), "")
    shown = [each for each in found.channels if each.name in values and each.name != time][:_MOST]
    picture, grid = panels(WIDE_in, 0.5 + 1.1 * max(len(shown), 1), max(len(shown), 1), 1, sharex=True, squeeze=False)
    for axes, each in zip(grid[:, 0], shown, strict=False):
        of_rows = np.arange(1.0, len(values[each.name]) + 1)
        curve(axes, values.get(time, of_rows), values[each.name], **MODEL)
        label(axes, title=verbatim(each.name if each.use in ("", each.name) else f"{each.name}  ({each.use})"))
    label(grid[-1, 0], verbatim(time) if time in values else "row")
    return save_all({"channels": picture}, folder, form)
