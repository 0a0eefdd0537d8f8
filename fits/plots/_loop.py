"""Pictures of a fit, for print: columns of 90 mm or 180 mm, readable in grey."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from fits.io._errors import AnyPath
from fits.io._record import Record
from fits.loop._result import FitResult, RunReport
from fits.loop._run import Run, prepare_run, simulate_run
from fits.plots._runs import Drawn, held_out, loops, over_time
from fits.plots._style import DARK, NARROW_in, WIDE_in, label, panels, save
from microid import Preisach, Reversible

_surfaces = eqx.filter_jit(lambda model, alpha, beta: (model.density(alpha, beta), model.everett(alpha, beta)))
_ALPHA = "\N{GREEK SMALL LETTER ALPHA}"


def plot_fit(
    result: FitResult[Preisach],
    records: Sequence[Record],
    folder: AnyPath,
    *,
    holdout: float | Sequence[Record] = 0.2,
    initial: str = "unknown",
) -> list[Path]:
    """Draw a fit: loops, density, Everett surface and, where something was held out, its prediction.

    Records, holdout and initial memory are those that `fit` was given; a ValueError says that they are not those of
    the result. `loops.png`, `density.png`, `everett.png` and `heldout.png` are written into an existing folder, at
    200 dots per inch; a `DataError` says if they cannot be.
    """
    fraction, aside = held_out(holdout, len(records), len(result.runs))
    range_V = float(result.model.density.lower_V), float(result.model.density.upper_V)
    runs = [prepare_run(record, range_V, initial, fraction) for record in records]
    runs += [prepare_run(record, range_V, initial, holdout=1.0) for record in aside]
    drawn = [_simulated(result, run, report) for run, report in zip(runs, result.runs, strict=True)]

    voltage, (density, everett) = _over_half_plane(result.model)
    pictures = {
        "loops": loops(drawn[: len(records)]),
        "density": _density(voltage, density, result.model.reversible),
        "everett": _everett(voltage, everett),
    }
    if predicted := [each for each in drawn if each.run.held_out.any()]:
        pictures["heldout"] = over_time(predicted, held_out_alone=True)
    return [save(picture, Path(folder) / f"{name}.png") for name, picture in pictures.items()]


def _simulated(result: FitResult[Preisach], run: Run, report: RunReport) -> Drawn:
    model = eqx.tree_at(lambda m: m.offset_um, result.model, jnp.asarray(report.offset_um))
    predicted = simulate_run(model, run)
    if not run.known.all():
        # The reported errors are those of the known samples; the start was estimated from the others.
        predicted = np.where(run.known, predicted, simulate_run(model, replace(run, start=report.start)))
    sd_um = result.uncertainty.sd_um(result.model, run) if run.held_out.any() else np.zeros(len(predicted))
    return Drawn(run, report, predicted, sd_um, result.noise_um)


def _over_half_plane(model: Preisach) -> tuple[np.ndarray, list[np.ma.MaskedArray]]:
    """Evaluate the density and the Everett surface on a mesh of voltages; beta runs along the last axis."""
    voltage = np.linspace(float(model.density.lower_V), float(model.density.upper_V), 361)
    alpha, beta = np.meshgrid(voltage, voltage, indexing="ij")
    surfaces = _surfaces(model, jnp.asarray(alpha), jnp.asarray(beta))
    return voltage, [np.ma.masked_where(alpha < beta, np.asarray(surface)) for surface in surfaces]


def _half_plane(axes: Axes, voltage: np.ndarray) -> None:
    axes.plot(voltage[[0, -1]], voltage[[0, -1]], color=DARK, linewidth=0.8)
    axes.set_aspect("equal")


def _density(voltage: np.ndarray, values: np.ma.MaskedArray, reversible: Reversible) -> Figure:
    picture, (plane, curve) = panels(WIDE_in, 2.9, 1, 2, width_ratios=(1.25, 1), gap=0.08)
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
    picture, axes = panels(NARROW_in, 2.9)
    filled = axes.contourf(voltage, voltage, values, levels=12, cmap="Greys")
    axes.contour(voltage, voltage, values, levels=filled.levels, colors=DARK, linewidths=0.4)
    _half_plane(axes, voltage)
    label(axes, "fall to β (V)", f"fall from {_ALPHA} (V)")
    picture.colorbar(filled, ax=axes).set_label("Everett surface (µm)")
    return picture
