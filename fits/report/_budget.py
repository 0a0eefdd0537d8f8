"""Error budgets in JSON values and in words."""

from typing import Any

from fits.machining._budget import AxisBudget, Budget
from fits.report._sensitivity import _columns

SCHEMA = "microid.budget/1"
_PARTS = (
    "stroke",
    "driving_highest",
    "driving_lowest",
    "machining_signed",
    "machining_worst_case",
    "machining_root_sum_square",
    "machining_voltage_worst_case",
    "machining_voltage_root_sum_square",
    "measuring",
    "signed",
    "worst_case",
    "root_sum_square",
)
_TOTALS = ("signed", "worst_case", "root_sum_square")


def budget_json(found: Budget) -> dict[str, Any]:
    """Put error budgets into JSON values, `microid.budget/1`; a measuring error that is not known is None."""
    return {
        "schema": SCHEMA,
        "level": found.level,
        "model_measures": found.measures,
        "piezo": {
            "stroke_um": found.driving.stroke_um,
            "slope_um_per_V": found.driving.slope_um_per_V,
            "driving_highest_um": found.driving.highest_um,
            "driving_lowest_um": found.driving.lowest_um,
            "driving_absolute_um": found.driving.absolute_um,
        },
        "sensor": {"error_um": found.noise_um, "zeroed": found.zeroed, "arm_mm": found.arm_mm},
        "axes": {name: _axis_json(axis) for name, axis in found.axes.items()},
        "remarks": list(found.remarks),
    }


def _axis_json(axis: AxisBudget) -> dict[str, Any]:
    unit = axis.output_unit
    return {
        "output_unit": unit,
        f"piezo_sensitivity_{unit}_per_um": axis.piezo_sensitivity,
        **{f"{name}_{unit}": getattr(axis, name) for name in _PARTS},
        **{f"{name}_pct": 100 * getattr(axis, name) / axis.stroke for name in _TOTALS},
        "share_of_squares": axis.shares,
    }


def describe_budget(found: Budget) -> str:
    """Put error budgets into a table and sentences, without a newline at the end."""
    driving = found.driving
    parts = ("stroke", "driving", "machining", "at fixed V", "measuring")
    rows: list[tuple[str, ...]] = [("", *parts, "signed", "worst case", "%", "rss", "%")]
    rows += [_row(axis) for axis in found.axes.values()]
    source = "its displacement" if found.measures == "pzt" else f"its displacement, {found.measures}, over the gain"
    lines = [
        f"piezo   {driving.stroke_um:.4g} um by {source}; {driving.slope_um_per_V:.4g} um/V leaves "
        f"{driving.lowest_um:+.3g} to {driving.highest_um:+.3g} um of hysteresis",
        f"sensor  {found.noise_um:.3g} um, twice its random part"
        + (", zeroed at rest" if found.zeroed else " and its offset")
        + (f", at {found.arm_mm:g} mm from the axes of rotation" if found.arm_mm else ""),
        "",
        *_columns(rows),
        "",
        "shares of the squares in rss:",
    ]
    shares: list[tuple[str, ...]] = [("", "driving", "machining", "measuring")]
    shares += [
        (name, *(f"{100 * share:.2f} %" for share in axis.shares.values())) for name, axis in found.axes.items()
    ]
    lines += _columns(shares)
    lines += [
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
        f"{_number(axis.stroke, 4)} {axis.output_unit}",
        _number(axis.driving, 3, "+"),
        _number(axis.machining_worst_case, 3),
        _number(axis.machining_voltage_worst_case, 3),
        "unknown" if axis.measuring is None else _number(axis.measuring, 3),
        _number(axis.signed, 3, "+"),
        _number(axis.worst_case, 3),
        f"{100 * axis.worst_case / axis.stroke:.2f}",
        _number(axis.root_sum_square, 3),
        f"{100 * axis.root_sum_square / axis.stroke:.2f}",
    )


def _number(value: float, digits: int, sign: str = "") -> str:
    """Significant digits, or whole numbers where these are more, without an exponent for large ones."""
    return f"{value:{sign}.0f}" if abs(value) >= 10**digits else f"{value:{sign}.{digits}g}"
