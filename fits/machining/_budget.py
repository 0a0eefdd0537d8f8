"""The error budget: driving, machining and measuring error of each axis, and their total (Eq. 1)."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import microid as m
from fits.control._compensate import static_equivalent
from fits.io._errors import DataError
from fits.io._jax_setup import require_float64
from fits.io._json import columns
from fits.io._length import length
from fits.io._printable import plain
from fits.io._summary import AbstractSummary
from fits.machining._design import Design
from fits.machining._gains import once_per_function, quick_jit
from fits.machining._idle import IdleNoise
from fits.machining._sensitivity import derivatives_of, output_scale, refuse_infinite
from fits.stage._model_file import AnyModel, model_given
from microid import kinetostatics as ks

Measures = Literal["pzt", "x", "y", "z", "alpha", "beta", "gamma"]


@dataclass(frozen=True)
class Driving:
    """What hysteresis adds to a piezo that is taken for proportional, over one loop of its whole range (Eq. 7).

    The proportional elongation is the line from the lowest voltage that leaves the smallest squares over the loop;
    the highest and lowest error, with their signs, are counted from it.
    """

    stroke_um: float
    slope_um_per_V: float
    highest_um: float
    lowest_um: float

    @property
    def absolute_um(self) -> float:
        """The larger of the two by size."""
        return max(abs(self.highest_um), abs(self.lowest_um))


@dataclass(frozen=True)
class AxisBudget:
    """The errors of one axis at the full elongation of its piezo, all in `output_unit`: `um` or `urad`.

    The stroke is the output there, and `piezo_sensitivity` the output per um of the piezo (Eq. 3). Driving errors are
    the largest to either side, with their signs. Those of machining are of all dimensions, each at plus one
    tolerance, the elongation being imposed (Eq. 4): the sum, the sum of the sizes, and the root of the sum of squares
    with the design's correlations; with `voltage` the same with the voltage being imposed, which the paper leaves
    out: the input stiffness then acts too. The measuring error of the sensor is None where it is not known.
    """

    axis: ks.Axis
    output_unit: str
    stroke: float
    piezo_sensitivity: float
    driving_highest: float
    driving_lowest: float
    machining_signed: float
    machining_worst_case: float
    machining_root_sum_square: float
    machining_voltage_worst_case: float
    machining_voltage_root_sum_square: float
    measuring: float | None

    @property
    def driving(self) -> float:
        """The larger driving error by size, with its sign, in `output_unit`."""
        return max(self.driving_highest, self.driving_lowest, key=abs)

    def _total(self, machining: float) -> ks.TotalError:
        return ks.total_error(self.driving, machining, self.measuring or 0.0)

    @property
    def signed(self) -> float:
        """Sum with signs (Eq. 1): `driving`, all dimensions at plus one tolerance, and a reading that is too high.

        In `output_unit`.
        """
        return float(self._total(self.machining_signed).signed)

    @property
    def worst_case(self) -> float:
        """Sum of sizes, in `output_unit`: no signs within the tolerances are worse."""
        return float(self._total(self.machining_worst_case).worst_case)

    @property
    def root_sum_square(self) -> float:
        """For parts, and dimensions, that are independent, in `output_unit`."""
        return float(self._total(self.machining_root_sum_square).root_sum_square)

    @property
    def shares(self) -> dict[str, float]:
        """What part of the squares in `root_sum_square` is from driving, machining and measuring."""
        parts = self.driving, self.machining_root_sum_square, self.measuring or 0.0
        total = sum(part**2 for part in parts)
        shares = (part**2 / total if total > 0 else 0.0 for part in parts)
        return dict(zip(("driving", "machining", "measuring"), shares, strict=True))


@dataclass(frozen=True, repr=False)
class Budget(AbstractSummary):
    """The error budgets of some axes by name, and what they rest on.

    These are the driving error of the piezo; what the displacement of the model was, the piezo's elongation (`pzt`)
    or the output of an axis; the measuring error of the sensor, and whether its offset is left out of that; the
    distance from the axis of rotation at which it reads, or None; and the level of the motion functions. Remarks are
    what a reader must know, one sentence each.
    """

    axes: dict[ks.Axis, AxisBudget]
    driving: Driving
    measures: Measures
    noise_um: float
    zeroed: bool
    arm_mm: float | None
    level: int
    remarks: tuple[str, ...]

    def __getitem__(self, axis: ks.Axis) -> AxisBudget:
        """Budget of an axis by its name."""
        return self.axes[axis]

    def summary(self) -> str:
        """Tell the errors of each axis, in its unit, in a table and sentences."""
        driving, axes = self.driving, self.axes.values()
        parts = ("stroke", "driving", "machining", "at fixed V", "measuring", "signed", "worst case", "%", "rss", "%")
        shares = [(axis.axis, *(f"{100 * share:.2f} %" for share in axis.shares.values())) for axis in axes]
        source = "its displacement" if self.measures == "pzt" else f"its displacement, {self.measures}, over the gain"
        lines = [
            f"piezo   {driving.stroke_um:.4g} um by {source}; {driving.slope_um_per_V:.4g} um/V leaves "
            f"{driving.lowest_um:+.3g} to {driving.highest_um:+.3g} um of hysteresis",
            f"sensor  {length(self.noise_um)}, twice its random part"
            + (", zeroed at rest" if self.zeroed else " and its offset")
            + (f", at {self.arm_mm:g} mm from the axes of rotation" if self.arm_mm else ""),
            "",
            *(f"  {row}" for row in columns([("", *parts), *map(_row, axes)], ">")),
            "",
            "shares of the squares in rss:",
            *(f"  {row}" for row in columns([("", "driving", "machining", "measuring"), *shares], ">")),
            "",
            "driving: the largest of a full loop, with its sign; machining: worst case over the tolerances at a "
            "fixed elongation, and at a fixed voltage",
            "signed: this driving error, all dimensions at plus one tolerance and a reading too high; rss: root sum "
            "of squares, of all dimensions too",
            *(f"Note: {remark}" for remark in self.remarks),
        ]
        return "\n".join(lines)


def budget(
    design: Design,
    model: AnyModel,
    idle: IdleNoise,
    axes: Sequence[ks.Axis] = ks.AXES,
    *,
    measures: Measures = "pzt",
    arm_mm: float | None = None,
    zeroed: bool = True,
) -> Budget:
    """Put driving, machining and measuring errors together (Eq. 1), each axis being driven over its whole range.

    The model is the fitted hysteresis of a piezo, of a stage what slow commands see, or a fit or the name of a file
    of one, and all piezos are taken to be like it; its displacement `measures` the piezo's elongation, or the output
    of an axis, which is then divided by its gain. The noise of the sensor is from `idle_noise`; zeroed at rest, the
    sensor has no offset. It reads a rotation at a distance of `arm_mm` from the axis: without that rotations have no
    measuring error, and none can be what the model measures.

    A `DataError` says that the model does not move, is a stage without hysteresis, or measures a rotation at no arm,
    a `RuntimeError` that JAX is not in double precision.
    """
    require_float64("budgets need")
    if arm_mm is not None and not (math.isfinite(arm_mm) and arm_mm > 0):
        raise DataError(f"expected an arm above 0 mm, found {arm_mm:g}; give the distance from the axis of rotation.")
    driving = _driving(design, model_given(model)[0], measures, arm_mm)
    noise_um = idle.error_um(zeroed)
    # In um, and in urad where the arm is known.
    measuring = {"um": noise_um, "rad": None if arm_mm is None else 1e3 * noise_um / arm_mm}
    found = once_per_function(axes, lambda axis: _of_axis(design, axis, driving, measuring[ks.MOTIONS[axis].unit]))
    remarks = (*_remarks(design, found, driving, arm_mm), *(f"Idle record: {remark}" for remark in idle.remarks))
    return Budget(found, driving, measures, noise_um, zeroed, arm_mm, design.level, remarks)


def _driving(design: Design, model: m.Preisach | m.Stage, measures: Measures, arm_mm: float | None) -> Driving:
    """Driving error in um of the piezo."""
    law = static_equivalent(model)
    lower_V, upper_V = float(law.density.lower_V), float(law.density.upper_V)
    # The largest error is a maximum, where a step this small changes it by a millionth of the loop.
    rise = np.linspace(lower_V, upper_V, 1001)
    error, highest_um = _loop(law, jnp.asarray(np.concatenate([rise, rise[-2::-1]])))
    # What the model calls a um is this many of the piezo.
    per_unit = 1.0
    if measures != "pzt" and ks.MOTIONS[measures].unit == "rad":
        if arm_mm is None:
            raise DataError(
                f"a model of {measures} measures a rotation by a displacement; say at which arm, such as 50 mm."
            )
        per_unit = 1e3 * arm_mm
    scale = 1.0 if measures == "pzt" else 1 / (per_unit * float(derivatives_of(design, measures).gain))
    stroke_um = scale * float(highest_um)
    if not stroke_um > 0:
        range_V = f"{lower_V:g} and {upper_V:g} V"
        raise DataError(f"expected a model that moves between {range_V}, found one that does not; fit it again.")
    figures = error.slope_um_per_V, error.signed_um.max(), error.signed_um.min()
    return Driving(stroke_um, *(scale * float(figure) for figure in figures))


@quick_jit
def _loop(law: m.Preisach, voltage_V: Float[Array, " n"]) -> tuple[ks.DrivingError, Float[Array, ""]]:
    """Driving error over a loop, and what the model moves up to its middle, which is the turn."""
    error = ks.driving_error(law, voltage_V)
    turn = len(voltage_V) // 2
    return error, error.signed_um[turn] + error.slope_um_per_V * (voltage_V[turn] - voltage_V[0])


def _of_axis(design: Design, axis: ks.Axis, driving: Driving, measuring: float | None) -> AxisBudget:
    scale, unit = output_scale(axis)
    # The load takes a fixed part of any free elongation.
    loaded_um = derivatives_of(design, axis).loaded_stroke_um
    free_um = driving.stroke_um * float(design.actuation.free_stroke_um / loaded_um)
    actuation = replace(design.actuation, free_stroke_um=jnp.asarray(free_um))
    derived = derivatives_of(design, axis, actuation)
    stroke = scale * float(derived.stroke)
    slope = scale * float(derived.by_voltage.piezo) * free_um / driving.stroke_um
    signed, worst, squares = _combined(design, derived.slopes_at_full_stroke, scale)
    _, voltage_worst, voltage_squares = _combined(design, derived.by_voltage.dimensions, scale)
    refuse_infinite(axis, (stroke, slope, worst, voltage_worst))
    highest, lowest = slope * driving.highest_um, slope * driving.lowest_um
    machining = signed, worst, squares, voltage_worst, voltage_squares
    return AxisBudget(axis, unit, stroke, slope, highest, lowest, *machining, measuring)


def _combined(design: Design, slopes: Mapping[str, Array], scale: float) -> tuple[float, float, float]:
    """Sum of the errors at plus one tolerance, of their sizes, and the root of their squares with correlations."""
    changes = scale * np.array([float(slopes[name]) * design.tolerance[name] for name in slopes])
    variance = float(changes @ design.correlation([*slopes]) @ changes)
    return float(changes.sum()), float(np.abs(changes).sum()), math.sqrt(max(variance, 0.0))


def _remarks(
    design: Design, axes: dict[ks.Axis, AxisBudget], driving: Driving, arm_mm: float | None
) -> Iterator[str]:
    turning = [axis for axis in axes if ks.MOTIONS[axis].unit == "rad"]
    if turning and arm_mm is None:
        yield (
            f"The measuring error of {', '.join(turning)} is left out: a displacement sensor reads a rotation at an "
            "arm; give it."
        )
    loaded_um = max(float(derivatives_of(design, axis).loaded_stroke_um) for axis in axes)
    if driving.stroke_um > 1.05 * loaded_um:
        yield (
            f"The model elongates its piezo by {driving.stroke_um:.4g} um, but against the stage the piezos of this "
            f"design reach {loaded_um:.4g} um: if it was measured without the stage, scale its displacement or say "
            "what it measures."
        )
    yield (
        "The totals take machining at a fixed elongation of the piezo (Eq. 4); open loop the voltage is fixed, and "
        "the column beside it counts."
    )


def _row(axis: AxisBudget) -> tuple[str, ...]:
    return (
        axis.axis,
        f"{plain(axis.stroke)} {axis.output_unit}",
        plain(axis.driving, 3, "+"),
        plain(axis.machining_worst_case, 3),
        plain(axis.machining_voltage_worst_case, 3),
        "unknown" if axis.measuring is None else plain(axis.measuring, 3),
        plain(axis.signed, 3, "+"),
        plain(axis.worst_case, 3),
        f"{100 * axis.worst_case / axis.stroke:.2f}",
        plain(axis.root_sum_square, 3),
        f"{100 * axis.root_sum_square / axis.stroke:.2f}",
    )
