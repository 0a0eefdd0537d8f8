"""Sensitivities and error budgets in JSON values and in words."""

import dataclasses
from collections.abc import Sequence
from typing import Any

from fits.io._printable import plain
from fits.machining._budget import AxisBudget, Budget
from fits.machining._sensitivity import AxisSensitivity, SensitivityReport
from fits.report._json import columns

_TOTALS = ("signed", "worst_case", "root_sum_square")


def sensitivity_json(report: SensitivityReport) -> dict[str, Any]:
    """Put sensitivities into JSON values, `microid.sensitivity/1`; parameters are ranked as in the report."""
    axes = {name: _sensitivity_json(axis) for name, axis in report.axes.items()}
    return {"schema": "microid.sensitivity/1", "level": report.level, "axes": axes}


def _sensitivity_json(axis: AxisSensitivity) -> dict[str, Any]:
    parameters = {}
    for effect in axis.dimensions:
        values = dict(vars(effect))
        values[f"output_change_{axis.output_unit}_per_10um"] = values.pop("output_change_per_10um")
        parameters[values.pop("name")] = values
    return {
        "gain": axis.gain,
        "gain_unit": axis.gain_unit,
        "loaded_stroke_um": axis.loaded_stroke_um,
        f"stroke_{axis.output_unit}": axis.stroke,
        "rss_pct": axis.rss_pct,
        "worst_case_pct": axis.worst_case_pct,
        "parameters": parameters,
        "fixed_voltage": {name: {"relative_change_pct": change} for name, change in axis.voltage_change_pct.items()},
    }


def describe_sensitivity(report: SensitivityReport, voltage: bool = False) -> str:
    """Put sensitivities into tables, one for each axis or two that are alike, without a newline at the end.

    With `voltage`, the relative changes at a fixed voltage are added.
    """
    note = (
        "at plus one tolerance and a fixed elongation of the piezo; per 10 um of the dimension, at full stroke; "
        "angles by 10 um across their leg"
    )
    tables = ["\n".join(_table(axes, report.level, voltage)) for axes in report.alike()]
    return "\n\n".join([*tables, note])


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


def budget_json(found: Budget) -> dict[str, Any]:
    """Put error budgets into JSON values, `microid.budget/1`; a measuring error that is not known is None."""
    driving = found.driving
    return {
        "schema": "microid.budget/1",
        "level": found.level,
        "model_measures": found.measures,
        "piezo": {
            "stroke_um": driving.stroke_um,
            "slope_um_per_V": driving.slope_um_per_V,
            "driving_highest_um": driving.highest_um,
            "driving_lowest_um": driving.lowest_um,
            "driving_absolute_um": driving.absolute_um,
        },
        "sensor": {"error_um": found.noise_um, "zeroed": found.zeroed, "arm_mm": found.arm_mm},
        "axes": {name: _budget_json(axis) for name, axis in found.axes.items()},
        "remarks": list(found.remarks),
    }


def _budget_json(axis: AxisBudget) -> dict[str, Any]:
    unit = axis.output_unit
    # All fields but the first two and the sensitivity are in the unit of the output.
    sizes = [each.name for each in dataclasses.fields(axis)[2:] if each.name != "piezo_sensitivity"]
    return {
        "output_unit": unit,
        f"piezo_sensitivity_{unit}_per_um": axis.piezo_sensitivity,
        **{f"{name}_{unit}": getattr(axis, name) for name in (*sizes, *_TOTALS)},
        **{f"{name}_pct": 100 * getattr(axis, name) / axis.stroke for name in _TOTALS},
        "share_of_squares": axis.shares,
    }


def describe_budget(found: Budget) -> str:
    """Put error budgets into a table and sentences, without a newline at the end."""
    driving, axes = found.driving, found.axes.values()
    parts = ("stroke", "driving", "machining", "at fixed V", "measuring", "signed", "worst case", "%", "rss", "%")
    shares = [(axis.axis, *(f"{100 * share:.2f} %" for share in axis.shares.values())) for axis in axes]
    source = "its displacement" if found.measures == "pzt" else f"its displacement, {found.measures}, over the gain"
    lines = [
        f"piezo   {driving.stroke_um:.4g} um by {source}; {driving.slope_um_per_V:.4g} um/V leaves "
        f"{driving.lowest_um:+.3g} to {driving.highest_um:+.3g} um of hysteresis",
        f"sensor  {found.noise_um:.3g} um, twice its random part"
        + (", zeroed at rest" if found.zeroed else " and its offset")
        + (f", at {found.arm_mm:g} mm from the axes of rotation" if found.arm_mm else ""),
        "",
        *(f"  {row}" for row in columns([("", *parts), *map(_row, axes)], ">")),
        "",
        "shares of the squares in rss:",
        *(f"  {row}" for row in columns([("", "driving", "machining", "measuring"), *shares], ">")),
        "",
        "driving: the largest of a full loop, with its sign; machining: worst case over the tolerances at a fixed "
        "elongation, and at a fixed voltage",
        "signed: this driving error, all dimensions at plus one tolerance and a reading too high; rss: root sum of "
        "squares, of all dimensions too",
        *(f"Note: {remark}" for remark in found.remarks),
    ]
    return "\n".join(lines)


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
