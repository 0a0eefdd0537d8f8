"""What machining errors do to each axis: derivatives, ranking, and shares of the variance (Eq. 4 and 5)."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import NDArray

from fits.io._errors import DataError
from fits.io._jax_setup import require_float64
from fits.io._json import columns
from fits.io._summary import AbstractSummary
from fits.machining._design import Design, uniform_tolerance
from fits.machining._gains import check_axes, gain_model, gains_of_few, once_per_function, quick_jit, twin
from fits.machining._tolerances import tolerances
from microid import kinetostatics as ks

# So short a stroke that all motions are in proportion to it, to the last digit.
SHORT_um = 1e-6


@dataclass(frozen=True)
class DimensionEffect:
    """What an error of one dimension does to one axis, the piezo's elongation being imposed.

    The `value` of the dimension and its tolerance are in mm or rad. The derivative is that of the gain, in its unit
    per mm or rad; relative changes are those of the output at an error of plus one tolerance, to first order and
    without linearising. With correlated dimensions the share of the variance, to first order, can be negative; it is
    zero where no tolerance has any effect, otherwise the shares of an axis add up to 1. `output_change_per_10um` is
    that at the full stroke of the loaded piezo, to first order, in um or urad per 10 um of a length, or of 10 um
    across the leg of an angle.
    """

    name: str
    unit: str
    value: float
    tolerance: float
    derivative: float
    relative_change_pct: float
    relative_change_exact_pct: float
    share_of_variance: float
    output_change_per_10um: float


@dataclass(frozen=True)
class AxisSensitivity:
    """The sensitivities of one axis, whose outputs are in `output_unit`: `um` or `urad`.

    The gain is the output per um of the piezo for small strokes; the stroke is the output at `loaded_stroke_um`, the
    elongation of the loaded piezo at the highest voltage (Eq. 14). Dimensions are the arguments of Eq. 5, largest
    relative change first; `rss_pct` is the root sum of squares of these changes, with their correlations, and
    `worst_case_pct` the sum of their sizes. `voltage_change_pct` is the relative change of the output at plus one
    tolerance, to first order, the voltage being imposed instead of the elongation: for every dimension that has an
    effect, also by the input stiffness, largest first.
    """

    axis: ks.Axis
    output_unit: str
    gain: float
    loaded_stroke_um: float
    stroke: float
    dimensions: tuple[DimensionEffect, ...]
    rss_pct: float
    worst_case_pct: float
    voltage_change_pct: dict[str, float]

    @property
    def gain_unit(self) -> str:
        """Unit of the gain: `um/um` or `urad/um`."""
        return f"{self.output_unit}/um"

    def __getitem__(self, name: str) -> DimensionEffect:
        """Effect of a dimension by its name."""
        effects = {effect.name: effect for effect in self.dimensions}
        if name not in effects:
            raise KeyError(f"{self.axis} does not depend on {name!r}: choose one of {', '.join(effects)}")
        return effects[name]


@dataclass(frozen=True, repr=False)
class SensitivityReport(AbstractSummary):
    """The sensitivities of some axes by name, and the level they hold at."""

    level: int
    axes: dict[ks.Axis, AxisSensitivity]

    def __getitem__(self, axis: ks.Axis) -> AxisSensitivity:
        """Sensitivities of an axis by its name."""
        return self.axes[axis]

    def summary(self, voltage: bool = False) -> str:
        """Rank the dimensions of each axis in tables; with `voltage` add the relative changes at a fixed voltage."""
        note = (
            "at plus one tolerance and a fixed elongation of the piezo; per 10 um of the dimension, at full stroke; "
            "angles by 10 um across their leg"
        )
        tables = ["\n".join(_table(axes, self.level, voltage)) for axes in self.alike()]
        return "\n\n".join([*tables, note])

    def alike(self) -> list[list[AxisSensitivity]]:
        """Group axes that are the same function of the same dimensions."""
        firsts = dict.fromkeys(map(twin, self.axes))
        return [[axis for name, axis in self.axes.items() if twin(name) == first] for first in firsts]


def sensitivities(design: Design, axes: Sequence[ks.Axis] = ks.AXES) -> SensitivityReport:
    """Differentiate the motion of a stage with respect to its dimensions, for all axes by default.

    The derivatives are those of the implicit motion functions (Eq. 4, with the inverse that the paper leaves out,
    erratum 6). A `DataError` says that the dimensions are such that no finite number comes out, a `RuntimeError` that
    JAX is not in double precision.
    """
    require_float64("sensitivities need")
    chosen: Sequence[ks.Axis] = (axes,) if isinstance(axes, str) else axes  # type: ignore[assignment]
    check_axes(chosen)
    return SensitivityReport(design.level, once_per_function(chosen, lambda axis: _of_axis(design, axis)))


class AxisDerivatives(eqx.Module):
    """Numbers of one axis in um, mm and rad, dimensions in the order of Eq. 5."""

    gain: Float[Array, ""]
    slopes: dict[str, Float[Array, ""]]
    loaded_stroke_um: Float[Array, ""]
    stroke: Float[Array, ""]
    slopes_at_full_stroke: dict[str, Float[Array, ""]]
    by_voltage: ks.Sensitivity


def derivatives_of(design: Design, axis: ks.Axis, actuation: ks.Actuation | None = None) -> AxisDerivatives:
    """Differentiate the motion of an axis, with the design's piezos or others."""
    return _differentiate(twin(axis), design.geometry, design.constants, actuation or design.actuation)


@quick_jit
def _differentiate(
    axis: ks.Axis, geometry: ks.Geometry, constants: ks.Constants, actuation: ks.Actuation
) -> AxisDerivatives:
    piezo = (actuation.free_stroke_um, constants, actuation.piezo_N_per_um)
    full_um = ks.loaded_um(axis, geometry, *piezo)
    strokes_um = jnp.stack([jnp.full_like(full_um, SHORT_um), full_um])
    found = jax.vmap(lambda stroke_um: ks.sensitivity(axis, geometry, stroke_um, constants))(strokes_um)
    slopes = {name: slope[0] / SHORT_um for name, slope in found.dimensions.items()}
    at_full_stroke = {name: slope[1] for name, slope in found.dimensions.items()}
    by_voltage = ks.voltage_sensitivity(axis, geometry, *piezo)
    return AxisDerivatives(found.piezo[0], slopes, full_um, found.output[1], at_full_stroke, by_voltage)


def gains_at(design: Design, axis: ks.Axis, errors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Gain of an axis in um/um or rad/um, shape `(n,)`, with errors of the arguments of Eq. 5, shape `(n, k)`."""
    return np.asarray(gains_of_few(gain_model(design), errors.T, (twin(axis),), ks.MOTIONS[axis].dimensions)[0])


def output_scale(axis: ks.Axis) -> tuple[float, str]:
    """Unit in which the output of an axis is shown, and what to multiply an output in um or rad by."""
    return (1e6, "urad") if ks.MOTIONS[axis].unit == "rad" else (1.0, "um")


def refuse_infinite(axis: ks.Axis, numbers: Iterable[float]) -> None:
    """Raise a `DataError` if a design leads to numbers that are not finite."""
    if not np.all(np.isfinite([*numbers])):
        raise DataError(
            f"{axis}: expected dimensions of a stage that moves, found some that are so small or so large that no "
            "finite number comes out; correct them."
        )


def _of_axis(design: Design, axis: ks.Axis) -> AxisSensitivity:
    names = ks.MOTIONS[axis].dimensions
    derived = derivatives_of(design, axis)
    gain, stroke, tolerance = float(derived.gain), float(derived.stroke), tolerances(design, names)
    slopes = np.array([float(derived.slopes[name]) for name in names])
    changes = slopes * tolerance / gain
    exact = gains_at(design, axis, np.diag(tolerance)) / gain - 1
    by_voltage = {
        name: 100 * float(slope) * design.tolerance[name] / float(derived.by_voltage.output)
        for name, slope in derived.by_voltage.dimensions.items()
        if slope != 0
    }
    refuse_infinite(axis, [*changes, *exact, *slopes, *by_voltage.values(), stroke, gain if gain > 0 else math.nan])
    scale, unit = output_scale(axis)
    parts = changes * (design.correlation(names) @ changes)
    variance = float(parts.sum())
    ten_um = uniform_tolerance(design.geometry, length_mm=0.01)
    shares = parts / variance if variance > 0 else np.zeros_like(parts)
    sizes = [float(design.geometry[name]) for name in names]
    per_10um = [scale * float(derived.slopes_at_full_stroke[name]) * ten_um[name] for name in names]
    columns = sizes, tolerance, scale * slopes, 100 * changes, 100 * exact, shares, per_10um
    rows = zip(names, np.stack(columns, axis=1).tolist(), strict=True)
    effects = [DimensionEffect(name, ks.DIMENSIONS[name].unit, *row) for name, row in rows]
    effects.sort(key=lambda effect: -abs(effect.relative_change_pct))
    by_voltage = dict(sorted(by_voltage.items(), key=lambda item: -abs(item[1])))
    rss_pct, worst_case_pct = 100 * math.sqrt(max(variance, 0.0)), 100 * float(np.abs(changes).sum())
    motion = scale * gain, float(derived.loaded_stroke_um), scale * stroke
    return AxisSensitivity(axis, unit, *motion, tuple(effects), rss_pct, worst_case_pct, by_voltage)


def _table(axes: Sequence[AxisSensitivity], level: int, voltage: bool) -> list[str]:
    axis, title = axes[0], " and ".join(each.axis for each in axes)
    unit = axis.output_unit
    rows = [("", "value", "tolerance", f"{unit}/10 um", "% of output", "exact %", "share")]
    rows += [
        (
            effect.name,
            f"{effect.value:.6g} {effect.unit}",
            f"{effect.tolerance:.3g} {effect.unit}",
            f"{effect.output_change_per_10um:+.3g}",
            f"{effect.relative_change_pct:+.3f}",
            f"{effect.relative_change_exact_pct:+.3f}",
            f"{effect.share_of_variance:.4f}",
        )
        for effect in axis.dimensions
    ]
    lines = [
        f"{title}: {axis.gain:.6g} {axis.gain_unit}, {axis.stroke:.5g} {unit} at {axis.loaded_stroke_um:.4g} um of "
        f"the loaded piezo, level {level}",
        *(f"  {row}" for row in columns(rows, ">")),
        f"  root sum of squares {axis.rss_pct:.2f} %, worst case {axis.worst_case_pct:.2f} %",
    ]
    if voltage:
        changes = ", ".join(f"{name} {change:+.3g}" for name, change in axis.voltage_change_pct.items())
        lines.append(f"  at a fixed voltage, % of output: {changes or 'none'}")
    return lines
