"""Sensitivities and error budgets in words."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from fits.io._json import columns
from fits.io._length import length
from fits.io._printable import plain

if TYPE_CHECKING:
    from fits.machining._budget import AxisBudget, Budget
    from fits.machining._sensitivity import AxisSensitivity, SensitivityReport


def describe_sensitivity(report: "SensitivityReport", voltage: bool = False) -> str:
    """Put sensitivities into tables, one for each axis or two that are alike, without a newline at the end.

    With `voltage`, the relative changes at a fixed voltage are added.
    """
    note = (
        "at plus one tolerance and a fixed elongation of the piezo; per 10 um of the dimension, at full stroke; "
        "angles by 10 um across their leg"
    )
    tables = ["\n".join(_table(axes, report.level, voltage)) for axes in report.alike()]
    return "\n\n".join([*tables, note])


def _table(axes: Sequence["AxisSensitivity"], level: int, voltage: bool) -> list[str]:
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


def describe_budget(found: "Budget") -> str:
    """Put error budgets into a table and sentences, without a newline at the end."""
    driving, axes = found.driving, found.axes.values()
    parts = ("stroke", "driving", "machining", "at fixed V", "measuring", "signed", "worst case", "%", "rss", "%")
    shares = [(axis.axis, *(f"{100 * share:.2f} %" for share in axis.shares.values())) for axis in axes]
    source = "its displacement" if found.measures == "pzt" else f"its displacement, {found.measures}, over the gain"
    lines = [
        f"piezo   {driving.stroke_um:.4g} um by {source}; {driving.slope_um_per_V:.4g} um/V leaves "
        f"{driving.lowest_um:+.3g} to {driving.highest_um:+.3g} um of hysteresis",
        f"sensor  {length(found.noise_um)}, twice its random part"
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


def _row(axis: "AxisBudget") -> tuple[str, ...]:
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
