"""Pictures of a fit, for print: columns of 90 mm or 180 mm, readable in grey."""

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from fits.io._record import Record
from fits.loop._result import FitResult, RunReport
from fits.loop._run import Run, prepare_run, simulate_run
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
from fits.stats._metrics import Errors
from microid import Preisach, Reversible

# Half-width of a 95 % interval in standard deviations.
_TWO_SIDED_95 = 1.959964
# Runs side by side in one picture.
_MOST_RUNS = 3
_MESH = 361
_ALPHA = "\N{GREEK SMALL LETTER ALPHA}"


@dataclass(frozen=True)
class _Drawn:
    """A run with its prediction, as the report compares them."""

    run: Run
    report: RunReport
    predicted_um: np.ndarray


def plot_fit(
    result: FitResult[Preisach],
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
    range_V = float(result.model.density.lower_V), float(result.model.density.upper_V)
    runs = [prepare_run(record, range_V, initial, fraction) for record in records]
    runs += [prepare_run(record, range_V, initial, holdout=1.0) for record in aside]
    drawn = [_simulated(result, run, report) for run, report in zip(runs, result.runs, strict=True)]

    voltage, (density, everett) = _over_half_plane(result.model)
    pictures = {
        "loops": _loops(drawn[: len(records)]),
        "density": _density(voltage, density, result.model.reversible),
        "everett": _everett(voltage, everett),
    }
    held_out = [each for each in drawn if each.run.held_out.any()]
    if held_out:
        pictures["heldout"] = _heldout(result, held_out)
    return [save(picture, Path(folder) / f"{name}.png") for name, picture in pictures.items()]


def _simulated(result: FitResult[Preisach], run: Run, report: RunReport) -> _Drawn:
    model = eqx.tree_at(lambda m: m.offset_um, result.model, jnp.asarray(report.offset_um))
    predicted = simulate_run(model, run)
    if not run.known.all():
        # The reported errors are those of the known samples; the start was estimated from the others.
        predicted = np.where(run.known, predicted, simulate_run(model, replace(run, start=report.start)))
    return _Drawn(run, report, predicted)


def _columns(runs: Sequence[_Drawn], width_in: float) -> tuple[Figure, np.ndarray]:
    """Two rows of axes, values above errors, with a column for each of the first runs."""
    shown = min(len(runs), _MOST_RUNS)
    picture = figure(width_in if shown == 1 else WIDE_in, 3.6)
    axes = picture.subplots(2, shown, squeeze=False, sharex="col", height_ratios=(2.2, 1))
    label(axes[0, 0], "", "displacement (µm)")
    label(axes[1, 0], "", "error (µm)")
    return picture, axes


def _caption(axes: Axes, report: RunReport, errors: Errors | None) -> None:
    figures = "" if errors is None else f"\ne_rms {errors.e_rms_pct:.3g} %, e_max {errors.e_max_pct:.3g} %"
    axes.set_title(verbatim(report.source) + figures, loc="left", fontsize=7)


def _loops(runs: Sequence[_Drawn]) -> Figure:
    picture, axes = _columns(runs, NARROW_in)
    for each, (loop, error) in zip(runs, axes.T, strict=False):
        voltage, measured = each.run.record.voltage_V, each.run.displacement_um
        keep = thinned(measured)
        # Nested loops lie close together, so the lines are thinner than elsewhere.
        loop.plot(voltage[keep], measured[keep], label="measured", **MEASURED | {"linewidth": 1.1})
        loop.plot(voltage[keep], each.predicted_um[keep], label="fitted", **MODEL | {"linewidth": 0.3})
        off = (measured - each.predicted_um)[each.run.known]
        keep = thinned(off)
        error.axhline(0.0, color=LIGHT, linewidth=0.6)
        error.plot(voltage[each.run.known][keep], off[keep], color=DARK, linewidth=0.25)
        label(error, "voltage (V)")
        label(loop)
        _caption(error, each.report, each.report.in_sample)
    legend(picture, axes[:1, 0])
    return picture


def _heldout(result: FitResult[Preisach], runs: Sequence[_Drawn]) -> Figure:
    picture, axes = _columns(runs, WIDE_in)
    for each, (above, below) in zip(runs, axes.T, strict=False):
        samples = each.run.held_out
        time_s, measured = each.run.record.time_s[samples], each.run.displacement_um[samples]
        predicted = each.predicted_um[samples]
        half = _TWO_SIDED_95 * result.uncertainty.sd_um(result.model, each.run)[samples]
        noisy = np.hypot(half, _TWO_SIDED_95 * result.noise_um)
        keep = thinned(measured)
        above.plot(time_s[keep], measured[keep], label="measured", **MEASURED)
        above.plot(time_s[keep], predicted[keep], label="predicted", **MODEL)
        low, high = (predicted - half)[keep], (predicted + half)[keep]
        above.fill_between(time_s[keep], low, high, color="0.3", linewidth=0, zorder=1)
        keep = thinned(measured - predicted)
        below.plot(time_s[keep], (measured - predicted)[keep], color="0.6", linewidth=0.35, label="error")
        for curve, style, name in ((half, "-", "95 % band"), (noisy, ":", "95 % band with noise")):
            below.plot(time_s[keep], curve[keep], color=DARK, linestyle=style, linewidth=0.9, label=name)
            below.plot(time_s[keep], -curve[keep], color=DARK, linestyle=style, linewidth=0.9)
        label(below, "time (s)")
        label(above)
        _caption(below, each.report, each.report.held_out)
    legend(picture, axes[:, 0])
    return picture


@eqx.filter_jit
def _surfaces(
    model: Preisach, alpha_V: Float[Array, "m m"], beta_V: Float[Array, "m m"]
) -> tuple[Float[Array, "m m"], Float[Array, "m m"]]:
    return model.density(alpha_V, beta_V), model.everett(alpha_V, beta_V)


def _over_half_plane(model: Preisach) -> tuple[np.ndarray, list[np.ma.MaskedArray]]:
    """Evaluate the density and the Everett surface on a mesh of voltages; beta runs along the last axis."""
    voltage = np.linspace(float(model.density.lower_V), float(model.density.upper_V), _MESH)
    alpha, beta = np.meshgrid(voltage, voltage, indexing="ij")
    surfaces = _surfaces(model, jnp.asarray(alpha), jnp.asarray(beta))
    return voltage, [np.ma.masked_where(alpha < beta, np.asarray(surface)) for surface in surfaces]


def _half_plane(axes: Axes, voltage: np.ndarray) -> None:
    axes.plot(voltage[[0, -1]], voltage[[0, -1]], color=DARK, linewidth=0.8)
    axes.set_aspect("equal")


def _density(voltage: np.ndarray, values: np.ma.MaskedArray, reversible: Reversible) -> Figure:
    picture = figure(WIDE_in, 2.9, gap=0.08)
    plane, curve = picture.subplots(1, 2, width_ratios=(1.25, 1))
    # One sharp peak at the diagonal would otherwise leave the rest white.
    top = float(np.quantile(values.compressed(), 0.995)) or None
    mesh = plane.pcolormesh(voltage, voltage, values, cmap="Greys", vmin=0, vmax=top, rasterized=True)
    _half_plane(plane, voltage)
    label(plane, "switching down at β (V)", f"switching up at {_ALPHA} (V)")
    picture.colorbar(mesh, ax=plane, extend="max").set_label("density (µm/V²)")
    curve.plot(np.linspace(voltage[0], voltage[-1], reversible.levels), reversible.slope_um_per_V, color=DARK)
    curve.set_ylim(bottom=0)
    label(curve, "voltage (V)", "reversible slope (µm/V)")
    return picture


def _everett(voltage: np.ndarray, values: np.ma.MaskedArray) -> Figure:
    picture = figure(NARROW_in, 2.9)
    axes = picture.subplots()
    filled = axes.contourf(voltage, voltage, values, levels=12, cmap="Greys")
    axes.contour(voltage, voltage, values, levels=filled.levels, colors=DARK, linewidths=0.4)
    _half_plane(axes, voltage)
    label(axes, "fall to β (V)", f"fall from {_ALPHA} (V)")
    picture.colorbar(filled, ax=axes).set_label("Everett surface (µm)")
    return picture
