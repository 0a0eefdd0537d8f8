"""Pictures of runs on the paper's stage: Fig. 6, 9, 10, 11 and 12."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fits.plots._style import LIGHT, MEASURED, MODEL, WIDE_in, curve, label, legend, panels, save

_STYLES: dict[str, dict[str, Any]] = {
    "reference": {"color": "0.75", "linewidth": 2.5},
    "OPEN": {"color": "0.55", "linewidth": 1.0, "linestyle": ":"},
    "HC": {"color": "0.4", "linewidth": 0.9, "linestyle": "--"},
    "HC+PID": {"color": "0.5", "linewidth": 0.8},
    "HC+BP-PID": {"color": "0.25", "linewidth": 0.7, "linestyle": "-."},
    "HC+CMAC-PID": {"color": "0.0", "linewidth": 0.7},
}


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
