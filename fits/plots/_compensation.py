"""A picture of feedforward compensation, as the paper's Fig. 9."""

import os
from pathlib import Path

import numpy as np

from fits.control._compensate import Compensation
from fits.control._compensate_stage import simulate_model
from fits.io._record import Record, Reference
from fits.plots._style import DARK, LIGHT, MEASURED, MODEL, WIDE_in, curve, figure, label, legend, save
from fits.stats._metrics import TWO_SIDED_95
from microid import Preisach, Stage


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
    voltage over its reference. The error is that of the model, with the band in which the stage is expected, by the
    standard deviation of the displacement from `predict`, shape `(n,)`; without one no band is drawn.

    Model, reference and initial memory are those that `compensate` was given. `compensation.png` is written into an
    existing folder, at 200 dots per inch; a `DataError` says if it cannot be.
    """
    wanted, voltage, reached = compensation.reference_um, compensation.voltage_V, compensation.displacement_um
    straight_V = _straight(wanted, voltage)
    plain = simulate_model(model, Record(reference.time_s, straight_V, None, source=reference.source), initial)

    picture = figure(WIDE_in, 4.8, gap=0.08)
    (loop, inverse), (output, error) = picture.subplots(2, 2)
    curve(loop, straight_V, plain, "without compensation", **MEASURED)
    label(loop, "voltage (V)", "displacement (µm)", "loop")
    curve(inverse, wanted, voltage, "with compensation", **MODEL)
    label(inverse, "reference (µm)", "voltage (V)", "inverse loop")
    curve(output, wanted, plain, **MEASURED)
    curve(output, wanted, reached, **MODEL)
    label(output, "reference (µm)", "displacement (µm)", "output")
    off = reached - wanted
    error.axhline(0.0, color=LIGHT, linewidth=0.6)
    curve(error, reference.time_s, off, **MODEL)
    if displacement_sd_um is not None:
        half = TWO_SIDED_95 * displacement_sd_um
        for side, name in ((-half, ""), (half, "95 % band of the model")):
            curve(error, reference.time_s, off + side, name, color=DARK, linestyle=":", linewidth=0.7)
    label(error, "time (s)", "error (µm)", "error")
    legend(picture, (loop, inverse, error))
    return [save(picture, Path(folder) / "compensation.png")]


def _straight(wanted_um: np.ndarray, voltage_V: np.ndarray) -> np.ndarray:
    """A voltage proportional to the reference, within the voltages used."""
    centred = wanted_um - wanted_um.mean()
    power = float(centred @ centred)
    gain = float(centred @ voltage_V) / power if power > 0 else 0.0
    return np.clip(voltage_V.mean() + gain * centred, voltage_V.min(), voltage_V.max())
