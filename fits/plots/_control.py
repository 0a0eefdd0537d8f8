"""Pictures of a reference that is followed: feedforward, closed loops, and the paper's runs (Fig. 6, 9 to 12)."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes

from fits.control._compensate import simulate_model
from fits.control._follow import Compensation
from fits.control._tune_problem import Goal
from fits.control._tune_start import slope_array
from fits.io._errors import AnyPath
from fits.io._record import Record, Reference
from fits.plots._style import DARK, LIGHT, MEASURED, MODEL, WIDE_in, curve, label, legend, panels, save, save_all
from fits.stats._metrics import TWO_SIDED_95
from microid import Preisach, Stage
from microid.control import AbstractController, ControlledRun, Margins, loop_gain, margins

_STYLES: dict[str, dict[str, Any]] = {
    "reference": {"color": "0.75", "linewidth": 2.5},
    "OPEN": {"color": "0.55", "linewidth": 1.0, "linestyle": ":"},
    "HC": {"color": "0.4", "linewidth": 0.9, "linestyle": "--"},
    "HC+PID": {"color": "0.5", "linewidth": 0.8},
    "HC+BP-PID": {"color": "0.25", "linewidth": 0.7, "linestyle": "-."},
    "HC+CMAC-PID": {"color": "0.0", "linewidth": 0.7},
}
# What is no plant: levels to read by, and limits.
_GUIDE: dict[str, Any] = {"color": DARK, "linewidth": 0.6, "linestyle": ":"}
_LIMIT: dict[str, Any] = {"color": DARK, "linewidth": 0.8, "linestyle": "--"}
_LIMITS = "gain_margin_min", "phase_margin_min_deg", "sensitivity_peak_max"


def plot_control(
    run: ControlledRun,
    controller: AbstractController,
    plants: Sequence[Stage],
    folder: AnyPath,
    *,
    delay: int = 0,
    goal: Goal | None = None,
    form: str = "png",
) -> list[Path]:
    """Draw a run, and the loop gain and sensitivity of every plant, beside the limits of a goal.

    The run is from `microid.control.simulate_loop`, the controller and its delay in samples as they were given there;
    the first plant is the one that was run. `run` and `margins` are written into an existing folder, in the form
    `png` (200 dots per inch), `svg` or `pdf`; a `DataError` says if they cannot be.
    """
    time_s = np.asarray(run.time_s)
    picture, (above, error, below) = panels(WIDE_in, 5.2, 3, 1, sharex=True, height_ratios=(1.6, 1, 1))
    # One within the other, as all three are nearly the same.
    curve(above, time_s, np.asarray(run.reference_um), "reference", color="0.85", linewidth=5.0)
    curve(above, time_s, np.asarray(run.measured_um), "measured", color="0.55", linewidth=2.4)
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
    coarse = 0.5 / float(controller.interval_s) * np.logspace(-3.5, 0, 600)
    picture, (size, turn, peak) = panels(WIDE_in, 4.4, 3, 1, sharex=True)
    for k, plant in reversed(list(enumerate(plants))):
        how: dict[str, Any] = {"delay": delay, "slope_um_per_V": slope_array(plant)}
        found = np.asarray(loop_gain(linear, plant, jnp.asarray(coarse), **how))
        # The peak, which the margins are of, lies between two of these.
        at = int(np.argmax(np.abs(1 / (1 + found))))
        around = np.linspace(coarse[max(at - 1, 0)], coarse[min(at + 1, len(coarse) - 1)], 200)
        frequency = np.unique(np.concatenate([coarse, around]))
        gain = np.asarray(loop_gain(linear, plant, jnp.asarray(frequency), **how))
        style = MODEL | {"linewidth": 0.9} if k == 0 else {"color": LIGHT, "linewidth": 0.7}
        words = {0: "the model", 1: "within its uncertainty"}.get(k, "")
        size.loglog(frequency, np.abs(gain), label=words, **style)
        turn.semilogx(frequency, np.degrees(np.unwrap(np.angle(gain))), **style)
        peak.semilogx(frequency, np.abs(1 / (1 + gain)), **style)
    peak.set_xlim(coarse[0], coarse[-1])
    for axes, level in zip((size, turn, peak), (1.0, -180.0, 1.0), strict=True):
        axes.axhline(level, zorder=0, **_GUIDE)
    found_margins = margins(linear, plants[0], delay=delay, slope_um_per_V=slope_array(plants[0]))
    _mark_margins((size, turn, peak), found_margins, goal)
    label(size, "", "loop gain")
    label(turn, "", "phase (°)")
    label(peak, "frequency (Hz)", "sensitivity")
    legend(picture, (size, peak))
    return save_all(pictures | {"margins": picture}, folder, form)


def _mark_margins(panels_of: Sequence[Axes], found: Margins, goal: Goal | None) -> None:
    """Mark gain margin, phase margin and peak of the sensitivity on the model's curves, limits where they hold."""
    size, turn, peak = panels_of
    frequency, phases = (np.asarray(x) for x in turn.lines[-2].get_data())
    least, most_deg, most = (getattr(goal, name, None) for name in _LIMITS)
    gain, gain_Hz, phase_Hz, high = (
        float(x) for x in (found.gain_margin, found.gain_margin_Hz, found.phase_margin_Hz, found.sensitivity_peak)
    )
    if gain_Hz > 0:
        _mark(size, gain_Hz, 1 / gain, f"gain margin {gain:.3g} at {gain_Hz:.3g} Hz", 1 / least if least else None)
    if phase_Hz > 0:
        phase = float(np.interp(phase_Hz, frequency, phases))
        # -180 degrees, or a whole turn from there.
        level = 360 * round((phase + 180) / 360) - 180
        limit = None if most_deg is None else level + np.copysign(most_deg, phase - level)
        _mark(turn, phase_Hz, phase, f"phase margin {abs(phase - level):.3g}° at {phase_Hz:.3g} Hz", limit)
    if most is not None:
        peak.axhline(most, label="limit", **_LIMIT)
    peak_Hz = float(found.sensitivity_peak_Hz)
    _mark(peak, peak_Hz, high, f"peak {high:.3g} at {peak_Hz:.3g} Hz", None)


def _mark(axes: Axes, frequency_Hz: float, level: float, words: str, limit: float | None) -> None:
    """A dot, a short line at its limit, and above the panel what it is."""
    if limit is not None:
        axes.plot([frequency_Hz / 1.25, frequency_Hz * 1.25], [limit, limit], label="limit", **_LIMIT)
    axes.plot(frequency_Hz, level, "o", color="0.0", markersize=3.5)
    label(axes, title=words)


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
    label(loop, "voltage (V)", "displacement (µm)", "loop, predicted by the model")
    curve(inverse, wanted, voltage, "with compensation", **MODEL)
    label(inverse, "reference (µm)", "voltage (V)", "inverse loop")
    curve(output, wanted, plain, **MEASURED)
    curve(output, wanted, reached, **MODEL)
    label(output, "reference (µm)", "displacement (µm)", "output, predicted by the model")
    off = reached - wanted
    error.axhline(0.0, color=LIGHT, linewidth=0.6)
    curve(error, reference.time_s, off, **MODEL)
    if displacement_sd_um is not None:
        half = TWO_SIDED_95 * displacement_sd_um
        for side, name in ((-half, ""), (half, "95 % band of the model")):
            curve(error, reference.time_s, off + side, name, color=DARK, linestyle=":", linewidth=0.7)
    label(error, "time (s)", "error (µm)", "error, predicted by the model")
    legend(picture, (loop, inverse, error))
    return save_all({"compensation": picture}, folder, form)


def plot_loop(voltage_V: np.ndarray, measured_um: np.ndarray, model_um: np.ndarray, path: Path) -> Path:
    """Draw Fig. 6: the loops that were measured and those of the fit, and their difference."""
    picture, (loop, error) = panels(WIDE_in, 2.8, 1, 2, gap=0.08)
    loop.plot(voltage_V, measured_um, label="measured", **MEASURED)
    loop.plot(voltage_V, model_um, label="model", **MODEL)
    label(loop, "voltage (V)", "elongation (µm)")
    error.plot(voltage_V, 1e3 * (measured_um - model_um), ".", color="0.0", markersize=0.8, markeredgewidth=0)
    label(error, "voltage (V)", "measured less model (nm)")
    legend(picture, [loop])
    return save(picture, path)


def plot_inverse(
    voltage_V: np.ndarray,
    loop_um: np.ndarray,
    wanted_um: np.ndarray,
    inverse_V: np.ndarray,
    reached_um: np.ndarray,
    path: Path,
) -> Path:
    """Draw Fig. 9: the loop, the inverse loop, what came of the two in series on the bench, and its error."""
    picture, ((loop, inverse), (output, error)) = panels(WIDE_in, 4.8, 2, 2, gap=0.08)
    curves = [
        (loop, voltage_V, loop_um, "voltage (V)", "elongation (µm)"),
        (inverse, wanted_um, inverse_V, "wanted (µm)", "voltage (V)"),
        (output, wanted_um, reached_um, "wanted (µm)", "reached (µm)"),
        (error, wanted_um, 1e3 * (wanted_um - reached_um), "wanted (µm)", "error (nm)"),
    ]
    for letter, (axes, x, y, below, beside) in zip("abcd", curves, strict=True):
        axes.plot(x, y, **MODEL)
        label(axes, below, beside, f"({letter})", size_pt=8)
    return save(picture, path)


def plot_steps(time_s: np.ndarray, target_um: float, steps: Mapping[str, np.ndarray], path: Path) -> Path:
    """Draw Fig. 10: answers to a step by scheme, each of shape `(n,)`."""
    picture, axes = panels(WIDE_in, 2.8)
    axes.axhline(target_um, label="reference", **_STYLES["reference"])
    for scheme, displacement_um in steps.items():
        axes.plot(time_s, displacement_um, label=scheme, **_STYLES[scheme])
    axes.set_xlim(0, 1.2)
    label(axes, "time (s)", "displacement (µm)")
    legend(picture, [axes])
    return save(picture, path)


def plot_tracking(
    interval_s: float, runs: Sequence[tuple[str, np.ndarray, Mapping[str, np.ndarray]]], path: Path
) -> Path:
    """Draw Fig. 11 and 12: rows of a title, a reference and displacements by scheme, each of shape `(n,)`."""
    picture, rows = panels(WIDE_in, 2.1 * len(runs) + 0.4, len(runs), 2, gap=0.08, squeeze=False)
    for (shown, error), (title, reference_um, schemes) in zip(rows, runs, strict=True):
        time_s = interval_s * np.arange(len(reference_um))
        curve(shown, time_s, reference_um, "reference", **_STYLES["reference"])
        error.axhline(0, color=LIGHT, linewidth=0.6)
        for scheme, displacement_um in schemes.items():
            off_pct = 100 * (reference_um - displacement_um) / np.ptp(reference_um)
            curve(shown, time_s, displacement_um, scheme, **_STYLES[scheme])
            curve(error, time_s, off_pct, **_STYLES[scheme])
        label(shown, "time (s)", "displacement (µm)", title, size_pt=8)
        label(error, "time (s)", "error (%)")
    legend(picture, rows[:, 0])
    return save(picture, path)
