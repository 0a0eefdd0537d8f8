"""Runs beside what a fit makes of them: loops, and curves over time, with the errors below."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure

from fits.io._record import Record
from fits.loop._result import RunReport
from fits.loop._run import Run
from fits.plots import _style as style
from fits.stats._metrics import TWO_SIDED_95


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


def held_out(holdout: float | Sequence[Record], records: int, runs: int) -> tuple[float, Sequence[Record]]:
    """Tell the fraction that was held out from records; a ValueError where both are not the runs of a result."""
    fraction, aside = (float(holdout), ()) if isinstance(holdout, int | float) else (0.0, holdout)
    if records + len(aside) != runs:
        raise ValueError(f"the result has {runs} runs, and {records + len(aside)} records were given")
    return fraction, aside


def loops(runs: Sequence[Drawn]) -> Figure:
    """Draw displacement and error against the voltage, with a column for each of the first runs."""
    picture, axes = _columns(runs, style.NARROW_in if len(runs) == 1 else style.WIDE_in)
    for each, (loop, error) in zip(runs, axes.T, strict=False):
        voltage, known = each.run.record.voltage_V, each.run.known
        # Loops run over each other many times: lines of one kind would hide those of the other.
        style.curve(loop, voltage, each.predicted_um, "model", color=style.LIGHT, linewidth=1.4)
        style.dots(loop, voltage, each.run.displacement_um, "measured")
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
