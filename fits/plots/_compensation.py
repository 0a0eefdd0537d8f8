"""A picture of feedforward compensation, as the paper's Fig. 9."""

import os
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from fits.control._compensate import Compensation
from fits.control._compensate_stage import simulate_model
from fits.io._record import Record, Reference
from fits.plots._style import DARK, LIGHT, MEASURED, MODEL, WIDE_in, figure, label, legend, save, thinned
from microid import Preisach, Stage

# Half-width of a 95 % interval in standard deviations.
_TWO_SIDED_95 = 1.959964


def plot_compensation(
    model: Preisach | Stage,
    reference: Reference | Record,
    compensation: Compensation,
    displacement_sd_um: np.ndarray | None,
    folder: str | os.PathLike[str],
    *,
    initial: str = "negative",
) -> list[Path]:
    """Draw the loop, the inverse loop, the compensated output against its reference, and the error.

    The loop is that of the uncompensated stage: the model driven by the straight line through the compensating
    voltage over its reference. The error is that of the model, with the band in which the stage is expected.

    Parameters
    ----------
    model, reference, initial
        What `compensate` was given.
    compensation
        From `compensate`.
    displacement_sd_um
        Standard deviation of the model's displacement, shape `(n,)`, from `predict`; no band is drawn if None.
    folder
        Existing folder for `compensation.png`; 200 dots per inch.

    Returns
    -------
    list of Path
        The file written.

    Raises
    ------
    DataError
        If the file cannot be written.
    """
    wanted, voltage, reached = compensation.reference_um, compensation.voltage_V, compensation.displacement_um
    straight_V = _straight(wanted, voltage)
    plain = simulate_model(model, Record(reference.time_s, straight_V, None, source=reference.source), initial)

    picture = figure(WIDE_in, 4.8, gap=0.08)
    (loop, inverse), (output, error) = picture.subplots(2, 2)
    _line(loop, straight_V, plain, MEASURED, "without compensation")
    label(loop, "voltage (V)", "displacement (µm)")
    _line(inverse, wanted, voltage, MODEL, "with compensation")
    label(inverse, "reference (µm)", "voltage (V)")
    _line(output, wanted, plain, MEASURED)
    _line(output, wanted, reached, MODEL)
    label(output, "reference (µm)", "displacement (µm)")
    off = reached - wanted
    error.axhline(0.0, color=LIGHT, linewidth=0.6)
    _line(error, reference.time_s, off, MODEL)
    if displacement_sd_um is not None:
        half = _TWO_SIDED_95 * displacement_sd_um
        keep = thinned(half)
        for side in (-half, half):
            name = "95 % band of the model" if side is half else ""
            error.plot(
                reference.time_s[keep], (off + side)[keep], color=DARK, linestyle=":", linewidth=0.7, label=name
            )
    label(error, "time (s)", "error (µm)")
    for axes, title in zip((loop, inverse, output, error), ("loop", "inverse loop", "output", "error"), strict=True):
        axes.set_title(title, loc="left", fontsize=7)
    legend(picture, (loop, inverse, error))
    return [save(picture, Path(folder) / "compensation.png")]


def _straight(wanted_um: np.ndarray, voltage_V: np.ndarray) -> np.ndarray:
    """A voltage proportional to the reference, within the voltages used."""
    centred = wanted_um - wanted_um.mean()
    power = float(centred @ centred)
    gain = float(centred @ voltage_V) / power if power > 0 else 0.0
    return np.clip(voltage_V.mean() + gain * centred, voltage_V.min(), voltage_V.max())


def _line(axes: Axes, x: np.ndarray, y: np.ndarray, style: dict, name: str = "") -> None:
    keep = thinned(y)
    axes.plot(x[keep], y[keep], label=name, **style)
