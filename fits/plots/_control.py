"""Pictures of a reference that is followed: feedforward as in the paper's Fig. 9, and closed loops."""

from collections.abc import Sequence
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from fits.control._compensate_stage import simulate_model
from fits.control._follow import Compensation
from fits.control._tune_start import slope_array
from fits.io._errors import AnyPath
from fits.io._record import Record, Reference
from fits.plots._style import DARK, LIGHT, MEASURED, MODEL, WIDE_in, curve, label, legend, panels, save_all
from fits.stats._metrics import TWO_SIDED_95
from microid import AbstractController, ControlledRun, Preisach, Stage, loop_gain


def plot_control(
    run: ControlledRun,
    controller: AbstractController,
    plants: Sequence[Stage],
    folder: AnyPath,
    *,
    delay: int = 0,
    form: str = "png",
) -> list[Path]:
    """Draw a run, and the loop gain and sensitivity of every plant.

    The run is from `microid.simulate_loop`, the controller and its delay in samples as they were given there; the
    first plant is the one that was run. `run` and `margins` are written into an existing folder, in the form `png`
    (200 dots per inch), `svg` or `pdf`; a `DataError` says if they cannot be.
    """
    time_s = np.asarray(run.time_s)
    picture, (above, error, below) = panels(WIDE_in, 5.2, 3, 1, sharex=True, height_ratios=(1.6, 1, 1))
    curve(above, time_s, np.asarray(run.measured_um), "measured", **MEASURED)
    curve(above, time_s, np.asarray(run.reference_um), "reference", color=DARK, linewidth=0.9, linestyle="--")
    curve(above, time_s, np.asarray(run.displacement_um), "displacement", **MODEL)
    error.axhline(0.0, color=LIGHT, linewidth=0.6)
    curve(error, time_s, np.asarray(run.error_um), **MODEL)
    curve(below, time_s, np.asarray(run.command_V), **MODEL)
    label(above, "", "displacement (µm)")
    label(error, "", "error (µm)")
    label(below, "time (s)", "command (V)")
    legend(picture, (above,))
    pictures = {"run": picture}

    linear = controller.linear()
    frequency = 0.5 / float(controller.interval_s) * np.logspace(-3.5, 0, 600)
    picture, (size, turn, peak) = panels(WIDE_in, 4.4, 3, 1, sharex=True)
    for k, plant in reversed(list(enumerate(plants))):
        slope = slope_array(plant)
        gain = np.asarray(loop_gain(linear, plant, jnp.asarray(frequency), delay=delay, slope_um_per_V=slope))
        style = MODEL | {"linewidth": 0.9} if k == 0 else {"color": LIGHT, "linewidth": 0.7}
        words = {0: "the model", 1: "within its uncertainty"}.get(k, "")
        size.loglog(frequency, np.abs(gain), label=words, **style)
        turn.semilogx(frequency, np.degrees(np.unwrap(np.angle(gain))), **style)
        peak.semilogx(frequency, np.abs(1 / (1 + gain)), **style)
    for axes, level in ((size, 1.0), (turn, -180.0), (peak, 1.0)):
        axes.axhline(level, color=LIGHT, linewidth=0.6, zorder=0)
    label(size, "", "loop gain")
    label(turn, "", "phase (°)")
    label(peak, "frequency (Hz)", "sensitivity")
    legend(picture, (size,))
    return save_all(pictures | {"margins": picture}, folder, form)


def plot_compensation(
    model: Preisach | Stage,
    reference: Reference | Record,
    compensation: Compensation,
    displacement_sd_um: np.ndarray | None,
    folder: AnyPath,
    *,
    initial: str = "negative",
    form: str = "png",
) -> list[Path]:
    """Draw the loop, the inverse loop, the compensated output against its reference, and the error.

    The loop is that of the uncompensated stage: the model driven by the straight line through the compensating
    voltage over its reference. The error is that of the model, with the band in which the stage is expected, by the
    standard deviation of the displacement from `predict`, shape `(n,)`; without one no band is drawn.

    Model, reference and initial memory are those that `compensate` was given. `compensation` is written into an
    existing folder, in the form `png` (200 dots per inch), `svg` or `pdf`; a `DataError` says if it cannot be.
    """
    wanted, voltage, reached = compensation.reference_um, compensation.voltage_V, compensation.displacement_um
    # A voltage proportional to the reference, within the voltages used.
    centred = wanted - wanted.mean()
    gain = float(centred @ voltage) / (float(centred @ centred) or np.inf)
    straight_V = np.clip(voltage.mean() + gain * centred, voltage.min(), voltage.max())
    plain = simulate_model(model, Record(reference.time_s, straight_V, None, source=reference.source), initial)

    picture, ((loop, inverse), (output, error)) = panels(WIDE_in, 4.8, 2, 2, gap=0.08)
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
    return save_all({"compensation": picture}, folder, form)
