"""Pictures of a fit, for print, readable in grey: of a hysteresis alone, and of runs beside it or a stage."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogFormatter

from fits.io._errors import AnyPath
from fits.io._record import Record
from fits.loop._design import Grid, columns_of
from fits.loop._lost import without_lost
from fits.loop._parts_agree import predicted_um as surface_um
from fits.loop._result import FitResult, RunReport
from fits.loop._run import (
    Run,
    command_range_V,
    prepare_aside,
    prepare_runs,
    simulate_run,
)
from fits.loop._surface import Surface, continued
from fits.plots import _style as style
from fits.stage._began import prepare_asides
from fits.stage._checks import speed_Hz
from fits.stage._run import gain_ahead, prepare_again, residual_of
from fits.stage._start import MeasuredResponse, measure_response
from fits.stage._steps import hysteresis_alone
from fits.stats._metrics import TWO_SIDED_95
from microid import AbstractLinear, Preisach, Stage

# Voltages along either side of the surfaces.
_MESH = 361
_ALPHA = "\N{GREEK SMALL LETTER ALPHA}"


@dataclass(frozen=True)
class Drawn:
    """A run with its prediction and its standard deviation, as the report compares them, in um."""

    run: Run
    report: RunReport
    predicted_um: np.ndarray
    sd_um: np.ndarray
    noise_um: float

    @property
    def off_um(self) -> np.ndarray:
        """Measured less predicted, NaN where the unknown history still counts, shape `(n,)`."""
        return np.where(self.run.known, self.run.displacement_um - self.predicted_um, np.nan)


def told_apart(
    holdout: float | Sequence[Record], records: Sequence[Record], runs: int
) -> tuple[Sequence[Record], float, Sequence[Record]]:
    """The records that were fitted, the fraction that was held out of them, and those held out, as a fit reads them.

    A ValueError where these are not the runs of a result.
    """
    fraction, aside = (0.0, holdout) if isinstance(holdout, Sequence) else (float(holdout), ())
    if len(records) + len(aside) != runs:
        raise ValueError(f"the result has {runs} runs, and {len(records) + len(aside)} records were given")
    together, _ = without_lost([*records, *aside], 0.0)
    return together[: len(records)], fraction, together[len(records) :]


def loops_of(runs: Sequence[Drawn]) -> Figure:
    """Draw displacement and error against the voltage, with a column for each of the first runs."""
    picture, axes = _columns(runs, style.NARROW_in if len(runs) == 1 else style.WIDE_in)
    for each, (loop, error) in zip(runs, axes.T, strict=False):
        voltage, known = each.run.record.voltage_V, each.run.known
        # Loops run over each other many times: thick lines of the model would hide what was measured.
        style.curve(loop, voltage, each.predicted_um, "model", **style.MODEL | {"linewidth": 0.3})
        style.dots(loop, voltage, each.run.displacement_um, "measured", style.MEASURED["color"], 1.8)
        error.axhline(0.0, color=style.LIGHT, linewidth=0.6)
        style.dots(error, voltage[known], each.off_um[known])
        style.label(error, "voltage (V)")
        style.label(loop, title=_caption(each.report))
    style.legend(picture, axes[:1, 0])
    return picture


def over_time(runs: Sequence[Drawn], held_out_alone: bool = False) -> Figure:
    """Draw displacement and error against time, with their 95 % bands and a column for each of the first runs."""
    picture, axes = _columns(runs, style.WIDE_in)
    for each, (above, below) in zip(runs, axes.T, strict=False):
        samples = each.run.held_out if held_out_alone else np.ones(len(each.run.record), dtype=bool)
        time_s, predicted = each.run.record.time_s[samples], each.predicted_um[samples]
        half = TWO_SIDED_95 * each.sd_um[samples]
        style.curve(above, time_s, each.run.displacement_um[samples], "measured", **style.MEASURED)
        style.curve(above, time_s, predicted, "model", **style.MODEL)
        keep = style.thinned(predicted)
        low, high = (predicted - half)[keep], (predicted + half)[keep]
        above.fill_between(time_s[keep], low, high, color="0.3", linewidth=0, zorder=1)
        style.curve(below, time_s, each.off_um[samples], "error", color="0.6", linewidth=0.35)
        noisy = np.hypot(half, TWO_SIDED_95 * each.noise_um)
        for size, line, name in ((half, "-", "95 % band"), (noisy, ":", "95 % band with noise")):
            style.curve(below, time_s, size, name, color=style.DARK, linestyle=line, linewidth=0.8)
            style.curve(below, time_s, -size, color=style.DARK, linestyle=line, linewidth=0.8)
        aside = each.run.record.time_s[each.run.held_out]
        if not held_out_alone and len(aside) and each.run.fitted.any():
            # What the fit did not see, where it saw the rest.
            for panel in (above, below):
                panel.axvspan(aside[0], aside[-1], color="0.93", linewidth=0, zorder=0)
        style.label(below, "time (s)")
        style.label(above, title=_caption(each.report, held_out_alone))
    style.legend(picture, axes[:, 0])
    return picture


def _columns(runs: Sequence[Drawn], width_in: float) -> tuple[Figure, np.ndarray]:
    """Two rows of axes, values above errors, with a column for each of the first runs."""
    many = min(len(runs), 3)
    picture, axes = style.panels(width_in, 3.6, 2, many, 0.04, squeeze=False, sharex="col", height_ratios=(2, 1))
    style.label(axes[0, 0], "", "displacement (µm)")
    style.label(axes[1, 0], "", "error (µm)")
    return picture, axes


def _caption(report: RunReport, held_out_alone: bool = False) -> str:
    errors = report.held_out if held_out_alone else report.in_sample or report.held_out
    figures = "" if errors is None else f"\ne_rms {errors.e_rms_pct:.3g} %, e_max {errors.e_max_pct:.3g} %"
    return style.verbatim(report.source) + figures


def plot_fit(
    result: FitResult[Preisach],
    records: Sequence[Record],
    folder: AnyPath,
    *,
    holdout: float | Sequence[Record] = 0.2,
    initial: str = "unknown",
    form: str = "png",
) -> list[Path]:
    """Draw a fit: loops, density, Everett surface and, where something was held out, its prediction.

    Records, holdout and initial memory are those that `fit` was given; a ValueError says that they are not those of
    the result. `loops`, `density`, `everett` and `heldout` are written into an existing folder, in the form `png`
    (200 dots per inch), `svg` or `pdf`; a `DataError` says if they cannot be.
    """
    records, fraction, aside = told_apart(holdout, records, len(result.runs))
    range_V = float(result.model.density.lower_V), float(result.model.density.upper_V)
    runs = prepare_runs(records, range_V, initial, fraction)
    runs += [prepare_aside(record, range_V, initial) for record in aside]
    law = result.model
    grid, columns_um = Grid(law.density.lower_V, law.density.upper_V, law.density.levels), np.asarray(columns_of(law))
    surface = grid.surface(columns_um)
    drawn = [_simulated(result, surface, run, report) for run, report in zip(runs, result.runs, strict=True)]

    voltage, (density, everett) = _over_half_plane(grid, columns_um)
    pictures = {
        "loops": loops_of(drawn[: len(records)]),
        "density": _density(voltage, density, np.asarray(law.reversible.slope_um_per_V)),
        "everett": _everett(voltage, everett),
    }
    if predicted := [each for each in drawn if each.run.held_out.any()]:
        pictures["heldout"] = over_time(predicted, held_out_alone=True)
    return style.save_all(pictures, folder, form)


def _simulated(result: FitResult[Preisach], surface: Surface, run: Run, report: RunReport) -> Drawn:
    predicted = surface_um(surface, run) if run.has_past else report.offset_um + simulate_run(surface, run)
    if not run.known.all():
        # The reported errors are those of the known samples; the start was estimated from the others.
        before = report.offset_um + simulate_run(surface, replace(run, start=report.start))
        predicted = np.where(run.known, predicted, before)
    sd_um = result.uncertainty.sd_um(result.model, run) if run.held_out.any() else np.zeros(len(predicted))
    return Drawn(run, report, predicted, sd_um, result.noise_um)


def _over_half_plane(grid: Grid, columns_um: np.ndarray) -> tuple[np.ndarray, list[np.ma.MaskedArray]]:
    """Evaluate the density and the Everett surface on a mesh of voltages; beta runs along the last axis."""
    voltage, levels = np.linspace(*grid.ends_V, _MESH), np.linspace(*grid.ends_V, grid.levels)
    hats = np.stack([np.interp(voltage, levels, unit) for unit in np.eye(grid.levels)], axis=1)
    nodes = continued(grid.densities(columns_um[:, None])[0])[..., 0]
    surfaces = hats @ nodes @ hats.T, grid.surface(columns_um).over(voltage)[..., 0]
    below = voltage[:, None] < voltage
    return voltage, [np.ma.masked_where(below, surface) for surface in surfaces]


def _half_plane(axes: Axes, voltage: np.ndarray) -> None:
    axes.plot(voltage[[0, -1]], voltage[[0, -1]], color=style.DARK, linewidth=0.8)
    axes.set_aspect("equal")


def _density(voltage: np.ndarray, values: np.ma.MaskedArray, slope_um_per_V: np.ndarray) -> Figure:
    picture, (plane, slope) = style.panels(style.WIDE_in, 2.9, 1, 2, width_ratios=(1.25, 1), gap=0.08)
    # One sharp peak at the diagonal would otherwise leave the rest white.
    top = float(np.quantile(values.compressed(), 0.995)) or None
    mesh = plane.pcolormesh(voltage, voltage, values, cmap="Greys", vmin=0, vmax=top, rasterized=True)
    _half_plane(plane, voltage)
    style.label(plane, "switching down at β (V)", f"switching up at {_ALPHA} (V)")
    picture.colorbar(mesh, ax=plane, extend="max").set_label("density (µm/V²)")
    slope.plot(np.linspace(voltage[0], voltage[-1], len(slope_um_per_V)), slope_um_per_V, color=style.DARK)
    slope.set_ylim(bottom=0)
    style.label(slope, "voltage (V)", "reversible slope (µm/V)")
    return picture


def _everett(voltage: np.ndarray, values: np.ma.MaskedArray) -> Figure:
    picture, axes = style.panels(style.NARROW_in, 2.9)
    filled = axes.contourf(voltage, voltage, values, levels=12, cmap="Greys")
    axes.contour(voltage, voltage, values, levels=filled.levels, colors=style.DARK, linewidths=0.4)
    _half_plane(axes, voltage)
    style.label(axes, "fall to β (V)", f"fall from {_ALPHA} (V)")
    picture.colorbar(filled, ax=axes).set_label("Everett surface (µm)")
    return picture


# How far beyond the measured frequencies the model's response is drawn.
_BEYOND = 1.3
# Coherence from which a line counts as measured.
_COHERENT = 0.8


def plot_stage(
    result: FitResult[Stage],
    records: Sequence[Record],
    folder: AnyPath,
    *,
    holdout: float | Sequence[Record] = 0.2,
    initial: str | Sequence[str] = "unknown",
    form: str = "png",
) -> list[Path]:
    """Draw the fit of a stage: frequency response, runs with their residuals, and the loop of the slowest run.

    Records, holdout and initial memory are those that `fit_stage` was given; a ValueError says that they are not
    those of the result. `response` (where a run shows one), `runs`, `heldout` (where records were held out) and
    `loop` are written into an existing folder, in the form `png` (200 dots per inch), `svg` or `pdf`; a `DataError`
    if they cannot be.
    """
    records, fraction, aside = told_apart(holdout, records, len(result.runs))
    states = [initial] * len(records) if isinstance(initial, str) else list(initial)
    known = result.fitted_runs
    if len(records) != len(known):
        raise ValueError(f"the result is of {len(known)} fitted runs, and {len(records)} were given")
    # The runs are refined already.
    stage, gain = result.model.with_substeps(1), gain_ahead(result.model)
    range_V = command_range_V([*records, *aside])
    runs = prepare_again(result, records, states, fraction, range_V)
    before_aside = initial if isinstance(initial, str) else "unknown"
    stride = max(report.substeps or 1 for report in known)
    held = prepare_asides(stage, aside, range_V, before_aside, stride)
    runs += [replace(run, fitted=run.known) for run in held]
    noises = [report.noise_um or 0.0 for report in known]
    noises += [max(noises)] * len(aside)
    drawn = [
        Drawn(run, report, predicted_um(stage, run), result.uncertainty.sd_um(stage, run), noise)
        for run, report, noise in zip(runs, result.runs, noises, strict=True)
    ]
    fitted, predicted = drawn[: len(records)], drawn[len(records) :]
    pictures: dict[str, Figure] = {}
    behind = float(stage.static_gain) / (gain or 1.0)
    static_um = [behind * one for one in hysteresis_alone(stage, runs[: len(records)])]
    found = [(run.record.source, measure_response(run, drive)) for run, drive in zip(runs, static_um, strict=False)]
    if seen := [each for each in found if len(each[1].frequency_Hz)]:
        # Of the run that shows the highest frequencies.
        pictures["response"] = _response(stage, *max(seen, key=lambda each: _highest_Hz(each[1])))
    pictures["runs"] = over_time(fitted)
    if predicted:
        pictures["heldout"] = over_time(predicted)
    pictures["loop"] = loops_of([min(fitted, key=lambda each: speed_Hz(each.run.record))])
    return style.save_all(pictures, folder, form)


def predicted_um(stage: Stage, run: Run) -> np.ndarray:
    """What a stage predicts of a run, beside its nuisance parameters, in um, shape `(n,)`.

    NaN where the unknown history still counts: how the stage moved before is fitted to what follows, where that has
    died away, and led back from there it may be anything.
    """
    return np.where(run.known, run.displacement_um - residual_of(stage, run), np.nan)


def _highest_Hz(measured: MeasuredResponse) -> float:
    """The highest frequency that a run surely shows; that of its last line if it shows none surely."""
    sure = measured.frequency_Hz[measured.coherence > _COHERENT]
    return float((sure if len(sure) else measured.frequency_Hz).max())


def linear_parts(stage: Stage) -> str:
    """Names of the linear parts that move by themselves, in their order, as in "driver and mechanics"."""
    moving = [
        name.replace("_", " ")
        for name, part in zip(stage.names, stage.parts, strict=True)
        if isinstance(part, AbstractLinear) and part.system().order
    ]
    return " and ".join(moving) or "static gain"


def linear_gain(stage: Stage, frequency_Hz: np.ndarray) -> np.ndarray:
    """Frequency response of all linear parts over their static gain, complex, shape `(f,)`."""
    out = np.ones(len(frequency_Hz), dtype=complex)
    for part in stage.parts:
        if isinstance(part, AbstractLinear):
            out = out * np.asarray(part.frequency_response(jnp.asarray(frequency_Hz))) / float(part.static_gain)
    return out


def _response(stage: Stage, source: str, measured: MeasuredResponse) -> Figure:
    # Beyond what was excited there are only lines that noise put there.
    low, high = float(measured.frequency_Hz.min()), _BEYOND * _highest_Hz(measured)
    shown = measured.frequency_Hz <= high
    measured = MeasuredResponse(measured.frequency_Hz[shown], measured.response[shown], measured.coherence[shown])
    frequency = np.geomspace(low / _BEYOND, high, 600)
    model = linear_gain(stage, frequency)
    phase = np.unwrap(np.angle(model))
    at_lines = linear_gain(stage, measured.frequency_Hz)
    # The measured phase is drawn on the branch of the model's.
    near = np.interp(measured.frequency_Hz, frequency, phase) + np.angle(measured.response / at_lines)

    picture, (size, turn) = style.panels(style.WIDE_in, 3.9, 2, 1, sharex=True, height_ratios=(1.4, 1))
    # The less coherent a line, the lighter.
    shade = 0.45 + 0.45 * np.minimum(1.0, (1 - measured.coherence) / (1 - _COHERENT) / 2)
    grey: dict[str, Any] = {"c": shade, "cmap": "gray", "vmin": 0.0, "vmax": 1.0, "s": 8.0, "linewidths": 0.0}
    name = "measured (Welch: peaks are rounded)"
    size.scatter(measured.frequency_Hz, np.abs(measured.response), label=name, **grey)
    size.loglog(frequency, np.abs(model), label=linear_parts(stage), **style.MODEL)
    turn.scatter(measured.frequency_Hz, np.degrees(near), **grey)
    turn.semilogx(frequency, np.degrees(phase), **style.MODEL)
    turn.xaxis.set_major_formatter(LogFormatter())
    turn.xaxis.set_minor_formatter(LogFormatter(minor_thresholds=(1.0, 0.4)))
    title = f"{style.verbatim(source)}\nover the displacement that the hysteresis alone would give"
    style.label(size, "", "magnitude", title)
    style.label(turn, "frequency (Hz)", "phase (°)")
    style.legend(picture, (size,))
    return picture
