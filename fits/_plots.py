"""Pictures of a fit, for print: columns of 90 mm or 180 mm, readable in grey."""

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from fits._plot_style import DARK, LIGHT, MEASURED, MODEL, NARROW_in, WIDE_in, figure, label, save, thinned
from fits._record import Record
from fits._result import FitResult, RunReport
from fits._run import Run, prepare_run, simulate_run
from fits._uncertainty import sd_run

# Half-width of a 95 % interval in standard deviations.
_TWO_SIDED_95 = 1.959964
# Runs side by side in one picture.
_MOST_RUNS = 3
_MESH = 361


@dataclass(frozen=True)
class _Drawn:
    """A run with its prediction, as the report compares them."""

    run: Run
    report: RunReport
    predicted_um: np.ndarray

    @property
    def error_um(self) -> np.ndarray:
        return self.run.displacement_um - self.predicted_um


def plot_fit(
    result: FitResult,
    records: Sequence[Record],
    folder: str | os.PathLike[str],
    *,
    holdout: float | Sequence[Record] = 0.2,
    initial: str = "unknown",
) -> list[Path]:
    """Draw a fit: loops, density, Everett surface and, where something was held out, its prediction.

    Parameters
    ----------
    result
        From `fit`.
    records, holdout, initial
        What `fit` was given.
    folder
        Existing folder for `loops.png`, `density.png`, `everett.png` and `heldout.png`; 200 dots per inch.

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
    if len(records) + len(aside) != len(result.runs):
        raise ValueError(
            f"the result has {len(result.runs)} runs, and {len(records) + len(aside)} records were given"
        )
    lower, upper = float(result.model.density.lower_V), float(result.model.density.upper_V)
    runs = [prepare_run(record, lower, upper, initial, fraction) for record in records]
    for record in aside:
        run = prepare_run(record, lower, upper, initial, holdout=1.0)
        runs.append(replace(run, fitted=np.zeros_like(run.known)))
    drawn = [_simulated(result, run, report) for run, report in zip(runs, result.runs, strict=True)]

    pictures = {
        "loops": _loops(drawn[: len(records)]),
        "density": _density(result),
        "everett": _everett(result),
    }
    held_out = [each for each in drawn if each.run.held_out.any()]
    if held_out:
        pictures["heldout"] = _heldout(result, held_out)
    return [save(picture, Path(folder) / f"{name}.png") for name, picture in pictures.items()]


def _simulated(result: FitResult, run: Run, report: RunReport) -> _Drawn:
    density = result.model.density
    model = eqx.tree_at(lambda m: m.offset_um, result.model, jnp.asarray(report.offset_um))
    predicted = simulate_run(model, run)
    if not run.known.all():
        started = run.with_start(report.start, float(density.lower_V), float(density.upper_V))
        # The reported errors are those of the known samples; the start was estimated from the others.
        predicted = np.where(run.known, predicted, simulate_run(model, started))
    return _Drawn(run, report, predicted)


def _columns(runs: Sequence[_Drawn]) -> tuple[Figure, np.ndarray]:
    """Two rows of axes, values above errors, with a column for each of the first runs."""
    shown = min(len(runs), _MOST_RUNS)
    picture = figure(NARROW_in if shown == 1 else WIDE_in, 3.4)
    axes = picture.subplots(2, shown, squeeze=False, sharex="col", height_ratios=(2.2, 1))
    for number, each in enumerate(runs[:shown]):
        title = each.report.source if number < shown - 1 or len(runs) == shown else f"{each.report.source} (and more)"
        axes[0, number].set_title(title)
    return picture, axes


def _loops(runs: Sequence[_Drawn]) -> Figure:
    picture, axes = _columns(runs)
    for number, each in enumerate(runs[:_MOST_RUNS]):
        loop, error = axes[0, number], axes[1, number]
        voltage = each.run.record.voltage_V
        keep = thinned(each.run.displacement_um)
        loop.plot(voltage[keep], each.run.displacement_um[keep], label="measured", **MEASURED)
        loop.plot(voltage[keep], each.predicted_um[keep], label="fitted", **MODEL)
        loop.legend(loc="upper left")
        keep = thinned(each.error_um)
        error.axhline(0.0, color=LIGHT, linewidth=0.6)
        error.plot(voltage[keep], each.error_um[keep], color=DARK, linewidth=0.4)
        label(error, "voltage (V)", "error (µm)" if number == 0 else "")
        label(loop, "", "displacement (µm)" if number == 0 else "")
        _caption(error, each.report, held_out=False)
    return picture


def _heldout(result: FitResult, runs: Sequence[_Drawn]) -> Figure:
    picture, axes = _columns(runs)
    for number, each in enumerate(runs[:_MOST_RUNS]):
        above, below = axes[0, number], axes[1, number]
        samples = each.run.held_out
        time, measured, predicted = each.run.record.time_s, each.run.displacement_um, each.predicted_um
        time, measured, predicted = time[samples], measured[samples], predicted[samples]
        half = _TWO_SIDED_95 * sd_run(result.uncertainty, each.run)[samples]
        wide = np.hypot(half, _TWO_SIDED_95 * result.noise_um)
        keep = thinned(measured)
        band = {"color": LIGHT, "linewidth": 0, "label": "95 % band"}
        above.fill_between(time[keep], (predicted - half)[keep], (predicted + half)[keep], **band)
        above.plot(time[keep], measured[keep], label="measured", **MEASURED)
        above.plot(time[keep], predicted[keep], label="predicted", **MODEL)
        above.margins(y=0.25)
        above.legend(loc="upper center", ncols=3)
        keep = thinned(measured - predicted)
        below.plot(time[keep], (measured - predicted)[keep], color="0.55", linewidth=0.4, label="error")
        for curve, style, name in ((half, "-", "95 %"), (wide, ":", "with noise")):
            below.plot(time[keep], curve[keep], color=DARK, linestyle=style, linewidth=0.8, label=name)
            below.plot(time[keep], -curve[keep], color=DARK, linestyle=style, linewidth=0.8)
        below.margins(y=0.3)
        label(below, "time (s)", "error (µm)" if number == 0 else "")
        label(above, "", "displacement (µm)" if number == 0 else "")
        _caption(below, each.report, held_out=True)
    return picture


def _caption(axes: Axes, report: RunReport, held_out: bool) -> None:
    errors = report.held_out if held_out else report.in_sample
    if errors is not None:
        name = "held-out" if held_out else "in-sample"
        text = f"{name} e_rms {errors.e_rms_pct:.3g} %, e_max {errors.e_max_pct:.3g} %"
        axes.set_title(text, loc="left", fontsize=7)


def _mesh(result: FitResult) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Voltages, and the pairs `(alpha, beta)` of all of them; beta along the last axis."""
    density = result.model.density
    voltage = np.linspace(float(density.lower_V), float(density.upper_V), _MESH)
    alpha, beta = np.meshgrid(voltage, voltage, indexing="ij")
    return voltage, alpha, beta


def _half_plane(axes: Axes, voltage: np.ndarray) -> None:
    axes.plot(voltage[[0, -1]], voltage[[0, -1]], color=DARK, linewidth=0.8)
    axes.set_aspect("equal")


def _density(result: FitResult) -> Figure:
    density, reversible = result.model.density, result.model.reversible
    voltage, alpha, beta = _mesh(result)
    values = np.ma.masked_where(alpha < beta, np.asarray(density(jnp.asarray(alpha), jnp.asarray(beta))))
    picture = figure(WIDE_in, 2.9)
    plane, curve = picture.subplots(1, 2, width_ratios=(1.25, 1))
    # The darkest hundredth would otherwise leave the rest white: densities peak at the diagonal.
    top = float(np.quantile(values.compressed(), 0.99)) or None
    mesh = plane.pcolormesh(voltage, voltage, values, cmap="Greys", vmin=0, vmax=top, rasterized=True)
    _half_plane(plane, voltage)
    label(plane, "switching down, β (V)", "switching up, α (V)")
    bar = picture.colorbar(mesh, ax=plane, extend="max")
    bar.set_label("density (µm/V²)")
    curve.plot(np.linspace(voltage[0], voltage[-1], reversible.levels), reversible.slope_um_per_V, color=DARK)
    curve.set_ylim(bottom=0)
    label(curve, "voltage (V)", "reversible slope (µm/V)")
    return picture


def _everett(result: FitResult) -> Figure:
    voltage, alpha, beta = _mesh(result)
    values = np.asarray(result.everett(jnp.asarray(alpha), jnp.asarray(beta)))
    picture = figure(NARROW_in, 2.9)
    axes = picture.subplots()
    masked = np.ma.masked_where(alpha < beta, values)
    filled = axes.contourf(voltage, voltage, masked, levels=12, cmap="Greys")
    axes.contour(voltage, voltage, masked, levels=filled.levels, colors=DARK, linewidths=0.4)
    _half_plane(axes, voltage)
    label(axes, "fall to (V)", "fall from (V)")
    bar = picture.colorbar(filled, ax=axes)
    bar.set_label("Everett surface (µm)")
    return picture
