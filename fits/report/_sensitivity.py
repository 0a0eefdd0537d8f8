"""Sensitivities in JSON values and in words."""

import dataclasses
from collections.abc import Sequence
from typing import Any

from fits.machining._sensitivity import AxisSensitivity, DimensionEffect, SensitivityReport

SCHEMA = "microid.sensitivity/1"


def sensitivity_json(report: SensitivityReport) -> dict[str, Any]:
    """Put sensitivities into JSON values, `microid.sensitivity/1`; parameters are ranked as in the report."""
    return {
        "schema": SCHEMA,
        "level": report.level,
        "axes": {name: _axis_json(axis) for name, axis in report.axes.items()},
    }


def _axis_json(axis: AxisSensitivity) -> dict[str, Any]:
    return {
        "gain": axis.gain,
        "gain_unit": axis.gain_unit,
        "loaded_stroke_um": axis.loaded_stroke_um,
        f"stroke_{axis.output_unit}": axis.stroke,
        "rss_pct": axis.rss_pct,
        "worst_case_pct": axis.worst_case_pct,
        "parameters": {effect.name: _effect_json(effect, axis.output_unit) for effect in axis.dimensions},
        "fixed_voltage": {name: {"relative_change_pct": change} for name, change in axis.voltage_change_pct.items()},
    }


def _effect_json(effect: DimensionEffect, output_unit: str) -> dict[str, Any]:
    values = {key: value for key, value in dataclasses.asdict(effect).items() if key != "name"}
    values[f"output_change_{output_unit}_per_10um"] = values.pop("output_change_per_10um")
    return values


def describe_sensitivity(report: SensitivityReport, voltage: bool = False) -> str:
    """Put sensitivities into tables, one for each axis or two that are alike, without a newline at the end.

    Parameters
    ----------
    report
        From `sensitivities`.
    voltage
        Whether to add the relative changes at a fixed voltage.
    """
    tables: list[str] = []
    left = list(report.axes.values())
    while left:
        first = left[0]
        names = [each.axis for each in left if dataclasses.replace(each, axis=first.axis) == first]
        left = [each for each in left if each.axis not in names]
        tables.append("\n".join(_table(first, " and ".join(names), report.level, voltage)))
    note = (
        "at plus one tolerance and a fixed elongation of the piezo; per 10 um of the dimension, at full stroke; "
        "angles by 10 um across their leg"
    )
    return "\n\n".join([*tables, note])


def _table(axis: AxisSensitivity, title: str, level: int, voltage: bool) -> list[str]:
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
        f"the loaded piezo, level {level}"
    ]
    lines += _columns(rows)
    lines.append(f"  root sum of squares {axis.rss_pct:.2f} %, worst case {axis.worst_case_pct:.2f} %")
    if voltage:
        changes = ", ".join(f"{name} {change:+.3g}" for name, change in axis.voltage_change_pct.items())
        lines.append(f"  at a fixed voltage, % of output: {changes or 'none'}")
    return lines


def _columns(rows: Sequence[Sequence[str]]) -> list[str]:
    """Align cells, the first of a row to the left and all others to the right."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  "
        + "  ".join([f"{row[0]:{widths[0]}}", *(f"{cell:>{w}}" for cell, w in zip(row[1:], widths[1:], strict=True))])
        for row in rows
    ]
