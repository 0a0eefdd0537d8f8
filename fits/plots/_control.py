"""Pictures of a closed loop: what happened in it, and how far it is from instability."""

import os
from collections.abc import Sequence
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from fits.control._tune_start import slope_array
from fits.plots._style import DARK, LIGHT, MEASURED, MODEL, WIDE_in, curve, figure, label, legend, save
from microid import AbstractController, ControlledRun, Stage, loop_gain

_FREQUENCIES = 600
_DECADES = 3.5


def plot_control(
    run: ControlledRun,
    controller: AbstractController,
    plants: Sequence[Stage],
    folder: str | os.PathLike[str],
    *,
    delay: int = 0,
) -> list[Path]:
    """Draw a run, and the loop gain and sensitivity of every plant.

    The run is from `microid.simulate_loop`, the controller and its delay in samples as they were given there; the
    first plant is the one that was run. `run.png` and `margins.png` are written into an existing folder, at 200 dots
    per inch; a `DataError` says if they cannot be.
    """
    time_s = np.asarray(run.time_s)
    picture = figure(WIDE_in, 5.2)
    above, error, below = picture.subplots(3, 1, sharex=True, height_ratios=(1.6, 1, 1))
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
    files = [save(picture, Path(folder) / "run.png")]

    linear = controller.linear()
    nyquist = 0.5 / float(controller.interval_s)
    frequency = nyquist * np.logspace(-_DECADES, 0, _FREQUENCIES)
    picture = figure(WIDE_in, 4.4)
    size, turn, peak = picture.subplots(3, 1, sharex=True)
    for k, plant in reversed(list(enumerate(plants))):
        gain = np.asarray(
            loop_gain(linear, plant, jnp.asarray(frequency), delay=delay, slope_um_per_V=slope_array(plant))
        )
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
    return [*files, save(picture, Path(folder) / "margins.png")]
