"""Pictures of the fit of a stage: its frequency response, every run with its residual, and the slow loop."""

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogFormatter

from fits.control._compensate_stage import static_equivalent
from fits.io._record import Record
from fits.loop._result import FitResult, RunReport
from fits.loop._run import Run, prepare_run, simulate_run
from fits.plots._loop import _MOST_RUNS, _TWO_SIDED_95, _caption
from fits.plots._style import (
    DARK,
    LIGHT,
    MEASURED,
    MODEL,
    NARROW_in,
    WIDE_in,
    figure,
    label,
    legend,
    save,
    thinned,
    verbatim,
)
from fits.stage._run import gain_ahead, place_of_hysteresis, residual_of
from fits.stage._start import MeasuredResponse, measure_response
from microid import AbstractLinear, Preisach, Stage

# Frequencies at which the model's response is drawn, and how far beyond the measured ones.
_FREQUENCIES, _BEYOND = 600, 1.3
# Coherence from which a line counts as measured, and the lightest grey of those that do not.
_SURE, _FAINTEST = 0.8, 0.85


@dataclass(frozen=True)
class _Drawn:
    """A run with its prediction, as the report compares them."""

    run: Run
    report: RunReport
    predicted_um: np.ndarray
    sd_um: np.ndarray
    noise_um: float

    @property
    def off_um(self) -> np.ndarray:
        return self.run.displacement_um - self.predicted_um


def plot_stage(
    result: FitResult[Stage],
    records: Sequence[Record],
    folder: str | os.PathLike[str],
    *,
    holdout: float | Sequence[Record] = 0.2,
    initial: str | Sequence[str] = "unknown",
) -> list[Path]:
    """Draw the fit of a stage: frequency response, runs with their residuals, and the loop of the slowest run.

    Parameters
    ----------
    result
        From `fit_stage`.
    records, holdout, initial
        What `fit_stage` was given.
    folder
        Existing folder for `response.png` (where a run shows one), `runs.png`, `heldout.png` (where records were held
        out) and `loop.png`; 200 dots per inch.

    Returns
    -------
    list of Path
        The files written.

    Raises
    ------
    DataError
        If a file cannot be written.
    ValueError
        If the records are not those of the result.
    """
    fraction = float(holdout) if isinstance(holdout, int | float) else 0.0
    aside: Sequence[Record] = () if isinstance(holdout, int | float) else holdout
    states = [initial] * len(records) if isinstance(initial, str) else list(initial)
    known = result.fitted_runs
    if len(records) != len(known) or len(records) + len(aside) != len(result.runs):
        raise ValueError(
            f"the result has {len(result.runs)} runs, and {len(records) + len(aside)} records were given"
        )
    # The runs are refined already.
    stage = result.model.with_substeps(1)
    range_V = _range_V([*records, *aside])
    gain = gain_ahead(stage)
    before_aside = initial if isinstance(initial, str) else "unknown"
    runs = [
        prepare_run(record, range_V, state, fraction, report.substeps or 1, gain, stage.hold)
        for record, state, report in zip(records, states, known, strict=True)
    ]
    for record in aside:
        run = prepare_run(record, range_V, before_aside, 1.0, known[-1].substeps or 1, gain, stage.hold)
        runs.append(replace(run, fitted=run.known))
    noises = [report.noise_um or 0.0 for report in known]
    noises += [max(noises)] * len(aside)
    drawn = [
        _simulated(result, stage, run, report, noise)
        for run, report, noise in zip(runs, result.runs, noises, strict=True)
    ]
    fitted, predicted = drawn[: len(records)], drawn[len(records) :]
    pictures: dict[str, Figure] = {}
    response = _measured(stage, [each.run for each in fitted], states, fraction)
    if response is not None:
        pictures["response"] = _response(stage, *response)
    pictures["runs"] = _runs(fitted)
    if predicted:
        pictures["heldout"] = _runs(predicted)
    pictures["loop"] = _loop(min(fitted, key=lambda each: _speed_per_s(each.run.record)))
    return [save(picture, Path(folder) / f"{name}.png") for name, picture in pictures.items()]


def _range_V(records: Sequence[Record]) -> tuple[float, float]:
    return (
        min(float(record.voltage_V.min()) for record in records),
        max(float(record.voltage_V.max()) for record in records),
    )


def _speed_per_s(record: Record) -> float:
    """How fast a voltage moves, for its size."""
    rate = np.diff(record.voltage_V) / np.diff(record.time_s)
    return float(np.sqrt(np.mean(rate**2)) / np.ptp(record.voltage_V))


def _simulated(result: FitResult[Stage], stage: Stage, run: Run, report: RunReport, noise_um: float) -> _Drawn:
    predicted = run.displacement_um - residual_of(stage, run)
    return _Drawn(run, report, predicted, result.uncertainty.sd_um(stage, run), noise_um)


def _measured(
    stage: Stage, runs: Sequence[Run], states: Sequence[str], fraction: float
) -> tuple[str, MeasuredResponse] | None:
    """Frequency response behind the hysteresis, from the run that shows the highest frequencies."""
    found = []
    for run, state in zip(runs, states, strict=True):
        response = measure_response(run, _static_um(stage, run.record, state, fraction))
        if len(response.frequency_Hz):
            found.append((run.record.source, response))
    return max(found, key=lambda each: _highest_Hz(each[1]), default=None)


def _highest_Hz(measured: MeasuredResponse) -> float:
    """The highest frequency that a run surely shows; that of its last line if it shows none surely."""
    sure = measured.frequency_Hz[measured.coherence > _SURE]
    return float((sure if len(sure) else measured.frequency_Hz).max())


def _static_um(stage: Stage, record: Record, state: str, fraction: float) -> np.ndarray:
    """Displacement that the stage would have without delay, shape `(n,)`."""
    place = place_of_hysteresis(stage)
    law: Any = None if place is None else stage.parts[place]
    if isinstance(law, Preisach):
        static = static_equivalent(stage)
        lower, upper = float(static.density.lower_V), float(static.density.upper_V)
        return simulate_run(static, prepare_run(record, (lower, upper), state, fraction))
    if law is None:
        return float(stage.static_gain) * record.voltage_V
    return float(stage.static_gain) * np.asarray(law(jnp.asarray(record.voltage_V)))


def _linear(stage: Stage, frequency_Hz: np.ndarray) -> np.ndarray:
    """Response of all linear parts over that at rest, complex, shape `(f,)`."""
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
    frequency = np.geomspace(low / _BEYOND, high, _FREQUENCIES)
    model = _linear(stage, frequency)
    phase = np.unwrap(np.angle(model))
    at_lines = _linear(stage, measured.frequency_Hz)
    # The measured phase is drawn on the branch of the model's.
    near = np.interp(measured.frequency_Hz, frequency, phase) + np.angle(measured.response / at_lines)

    picture = figure(WIDE_in, 3.9)
    size, turn = picture.subplots(2, 1, sharex=True, height_ratios=(1.4, 1))
    grey = {
        "c": _FAINTEST * np.minimum(1.0, (1 - measured.coherence) / (1 - _SURE) / 2),
        "cmap": "gray",
        "vmin": 0.0,
        "vmax": 1.0,
        "s": 5.0,
        "linewidths": 0.0,
        "zorder": 3,
    }
    size.scatter(
        measured.frequency_Hz, np.abs(measured.response), label="measured (Welch: peaks are rounded)", **grey
    )
    size.loglog(frequency, np.abs(model), label="driver and mechanics", color="0.5", linewidth=1.2)
    turn.scatter(measured.frequency_Hz, np.degrees(near), **grey)
    turn.semilogx(frequency, np.degrees(phase), color="0.5", linewidth=1.2)
    turn.xaxis.set_major_formatter(LogFormatter())
    turn.xaxis.set_minor_formatter(LogFormatter(minor_thresholds=(1.0, 0.4)))
    label(size, "", "magnitude")
    label(turn, "frequency (Hz)", "phase (°)")
    size.set_title(
        f"{verbatim(source)}\nover the displacement that the hysteresis alone would give", loc="left", fontsize=7
    )
    legend(picture, (size,))
    return picture


def _runs(runs: Sequence[_Drawn]) -> Figure:
    """Displacement and residual against time, with a column for each of the first runs."""
    shown = runs[:_MOST_RUNS]
    picture = figure(WIDE_in, 3.9, gap=0.04)
    axes = picture.subplots(2, len(shown), squeeze=False, sharex="col", height_ratios=(1.6, 1))
    for each, (above, below) in zip(shown, axes.T, strict=True):
        time_s, measured = each.run.record.time_s, each.run.displacement_um
        keep = thinned(measured)
        above.plot(time_s[keep], measured[keep], label="measured", **MEASURED)
        above.plot(time_s[keep], each.predicted_um[keep], label="model", **MODEL)
        _residual(below, each)
        _mark_held_out(above, each)
        _mark_held_out(below, each)
        label(below, "time (s)")
        label(above)
        _caption(above, each.report, each.report.in_sample or each.report.held_out)
    label(axes[0, 0], "", "displacement (µm)")
    label(axes[1, 0], "", "error (µm)")
    legend(picture, axes[:, 0])
    return picture


def _residual(axes: Axes, each: _Drawn) -> None:
    time_s = each.run.record.time_s
    off = np.where(each.run.known, each.off_um, np.nan)
    keep = thinned(np.where(each.run.known, off, 0.0))
    axes.plot(time_s[keep], off[keep], color="0.6", linewidth=0.35, label="error")
    half = _TWO_SIDED_95 * each.sd_um
    noisy = np.hypot(half, _TWO_SIDED_95 * each.noise_um)
    for curve, style, name in ((half, "-", "95 % band"), (noisy, ":", "95 % band with noise")):
        keep = thinned(curve)
        axes.plot(time_s[keep], curve[keep], color=DARK, linestyle=style, linewidth=0.8, label=name)
        axes.plot(time_s[keep], -curve[keep], color=DARK, linestyle=style, linewidth=0.8)


def _mark_held_out(axes: Axes, each: _Drawn) -> None:
    """Shade what the fit did not see, where it saw the rest."""
    held_out = np.flatnonzero(each.run.held_out)
    if len(held_out) and each.run.fitted.any():
        time_s = each.run.record.time_s
        axes.axvspan(time_s[held_out[0]], time_s[held_out[-1]], color="0.93", linewidth=0, zorder=0)


def _loop(each: _Drawn) -> Figure:
    picture = figure(NARROW_in, 3.6)
    loop, error = picture.subplots(2, 1, sharex=True, height_ratios=(2.2, 1))
    voltage, measured = each.run.record.voltage_V, each.run.displacement_um
    keep = thinned(measured)
    # Nested loops lie close together, so the lines are thinner than elsewhere.
    loop.plot(voltage[keep], measured[keep], label="measured", **MEASURED | {"linewidth": 1.1})
    loop.plot(voltage[keep], each.predicted_um[keep], label="model", **MODEL | {"linewidth": 0.3})
    off, voltage = each.off_um[each.run.known], voltage[each.run.known]
    keep = thinned(off)
    error.axhline(0.0, color=LIGHT, linewidth=0.6)
    error.plot(voltage[keep], off[keep], color=DARK, linewidth=0.25)
    label(loop, "", "displacement (µm)")
    label(error, "voltage (V)", "error (µm)")
    _caption(loop, each.report, each.report.in_sample)
    legend(picture, (loop,))
    return picture
