"""A picture of the measuring error, as the paper's Fig. 8 with what it leaves out."""

import os
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from fits.io._record import Reference
from fits.machining._idle import IdleNoise
from fits.plots._style import DARK, LIGHT, MEASURED, MODEL, WIDE_in, curve, figure, label, legend, save, verbatim

_MOST_LINES = 5


def plot_idle(reference: Reference, noise: IdleNoise, folder: str | os.PathLike[str]) -> list[Path]:
    """Draw an idle record with its histogram, its spectrum with the lines found, and its Allan deviation.

    The noise is that of the record, from `idle_noise`. `idle.png` is written into an existing folder, at 200 dots per
    inch; a `DataError` says if it cannot be.
    """
    picture = figure(WIDE_in, 4.8, gap=0.08)
    grid = picture.add_gridspec(2, 8)
    readings = picture.add_subplot(grid[0, :7])
    histogram = picture.add_subplot(grid[0, 7], sharey=readings)
    spectrum, allan = picture.add_subplot(grid[1, :4]), picture.add_subplot(grid[1, 4:])
    _draw_readings(readings, histogram, reference, noise)
    _draw_spectrum(spectrum, noise)
    _draw_allan(allan, noise)
    legend(picture, (readings,))
    return [save(picture, Path(folder) / "idle.png")]


def _draw_readings(axes: Axes, margin: Axes, reference: Reference, noise: IdleNoise) -> None:
    values, half = reference.displacement_um, noise.error_um()
    curve(axes, reference.time_s, values, "readings", **MEASURED | {"linewidth": 0.4})
    for more, style, name in ((-half, ":", ""), (0.0, "-", "offset"), (half, ":", "offset ± measuring error")):
        for each in (axes, margin):
            each.axhline(noise.mean_um + more, color=DARK, linestyle=style, linewidth=0.8, label=name)
    label(axes, "time (s)", "displacement (µm)", verbatim(reference.source) or "readings")
    margin.hist(values, _edges(noise, values), orientation="horizontal", color=LIGHT)
    margin.tick_params(labelleft=False)
    margin.set_xticks([])
    label(margin, "count")


def _edges(noise: IdleNoise, values: np.ndarray) -> list[float]:
    """Bins of the histogram: of whole quanta where readings have one, so that no bin is empty by construction."""
    low, high = float(values.min()), float(values.max())
    width = (high - low) / min(40.0, np.sqrt(len(values)))
    if noise.resolution_um is None:
        return np.arange(low, high + width, width).tolist()
    width = noise.resolution_um * np.ceil(width / noise.resolution_um)
    return np.arange(low - noise.resolution_um / 2, high + width, width).tolist()


def _draw_spectrum(axes: Axes, noise: IdleNoise) -> None:
    density = noise.asd_um_per_rtHz
    curve(axes, noise.frequency_Hz, density, **MODEL)
    axes.set(xscale="log", yscale="log")
    at_Hz = [line.frequency_Hz for line in noise.lines[:_MOST_LINES]]
    if at_Hz:
        tops = [float(density[np.argmin(np.abs(noise.frequency_Hz - each))]) for each in at_Hz]
        axes.plot(at_Hz, tops, "v", color=DARK, markersize=3.5)
        for x, y in zip(at_Hz, tops, strict=True):
            axes.annotate(f"{x:.4g} Hz", (x, y), (3, 1), textcoords="offset points", fontsize=6)
    label(axes, "frequency (Hz)", "amplitude density (µm/√Hz)", "spectrum")


def _draw_allan(axes: Axes, noise: IdleNoise) -> None:
    time_s, deviation, sd = noise.averaging_s, noise.adev_um, noise.adev_sd_um
    axes.loglog(time_s, deviation, **MODEL | {"linewidth": 1.0})
    seen = deviation > 0
    low = np.maximum(deviation - sd, 0.1 * deviation)
    axes.fill_between(time_s[seen], low[seen], (deviation + sd)[seen], color=LIGHT, linewidth=0)
    axes.plot(time_s, deviation[0] * np.sqrt(time_s[0] / time_s), ":", color=DARK, linewidth=0.8, label="white noise")
    axes.plot(noise.bias_instability_s, noise.bias_instability_um, "o", color=DARK, markersize=3, label="minimum")
    axes.legend(frameon=False)
    label(axes, "averaging time (s)", "Allan deviation (µm)", "Allan deviation")
