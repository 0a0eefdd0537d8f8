"""Pictures of the fit of a stage, for print, readable in grey."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogFormatter

from fits.io._errors import AnyPath
from fits.io._record import Record
from fits.loop._result import FitResult
from fits.loop._run import command_range_V, prepare_run
from fits.plots import _style as style
from fits.plots._fit import Drawn, loops_of, over_time, told_apart
from fits.stage._checks import speed_Hz
from fits.stage._run import gain_ahead, residual_of
from fits.stage._start import MeasuredResponse, measure_response
from fits.stage._steps import hysteresis_alone
from microid import AbstractLinear, Stage

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
    fraction, aside = told_apart(holdout, len(records), len(result.runs))
    states = [initial] * len(records) if isinstance(initial, str) else list(initial)
    known = result.fitted_runs
    if len(records) != len(known):
        raise ValueError(f"the result is of {len(known)} fitted runs, and {len(records)} were given")
    # The runs are refined already.
    stage, gain = result.model.with_substeps(1), gain_ahead(result.model)
    range_V = command_range_V([*records, *aside])
    runs = [
        prepare_run(record, range_V, state, fraction, report.substeps or 1, gain, stage.hold)
        for record, state, report in zip(records, states, known, strict=True)
    ]
    before_aside = initial if isinstance(initial, str) else "unknown"
    for record in aside:
        run = prepare_run(record, range_V, before_aside, 1.0, known[-1].substeps or 1, gain, stage.hold)
        runs.append(replace(run, fitted=run.known))
    noises = [report.noise_um or 0.0 for report in known]
    noises += [max(noises)] * len(aside)
    drawn = [
        Drawn(run, report, run.displacement_um - residual_of(stage, run), result.uncertainty.sd_um(stage, run), noise)
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


def _highest_Hz(measured: MeasuredResponse) -> float:
    """The highest frequency that a run surely shows; that of its last line if it shows none surely."""
    sure = measured.frequency_Hz[measured.coherence > _COHERENT]
    return float((sure if len(sure) else measured.frequency_Hz).max())


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
    shade = 0.85 * np.minimum(1.0, (1 - measured.coherence) / (1 - _COHERENT) / 2)
    grey: dict[str, Any] = {"c": shade, "cmap": "gray", "vmin": 0.0, "vmax": 1.0, "s": 5.0, "linewidths": 0.0}
    grey["zorder"], name = 3, "measured (Welch: peaks are rounded)"
    size.scatter(measured.frequency_Hz, np.abs(measured.response), label=name, **grey)
    size.loglog(frequency, np.abs(model), label="driver and mechanics", color="0.5", linewidth=1.2)
    turn.scatter(measured.frequency_Hz, np.degrees(near), **grey)
    turn.semilogx(frequency, np.degrees(phase), color="0.5", linewidth=1.2)
    turn.xaxis.set_major_formatter(LogFormatter())
    turn.xaxis.set_minor_formatter(LogFormatter(minor_thresholds=(1.0, 0.4)))
    title = f"{style.verbatim(source)}\nover the displacement that the hysteresis alone would give"
    style.label(size, "", "magnitude", title)
    style.label(turn, "frequency (Hz)", "phase (°)")
    style.legend(picture, (size,))
    return picture
