"""Sensitivities and error budgets in JSON values."""

import dataclasses
from typing import Any

from fits.machining._budget import AxisBudget, Budget
from fits.machining._sensitivity import AxisSensitivity, SensitivityReport

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
