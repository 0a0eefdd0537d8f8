"""The report of a fit in words."""

from collections.abc import Mapping, Sequence
from itertools import combinations
from math import floor, inf, log10
from typing import Any

from fits.io._json import columns
from fits.io._length import length, length_unit
from fits.stats._metrics import WHITE

# Held-out errors up to this many times the fitted ones count as equal.
_EQUAL = 1.1


def describe(report: Mapping[str, Any]) -> str:
    """Put a report from `fit_report` into words: some twenty lines, without a newline at the end."""
    stage = "parts" in report
    lines = _said_of_misfit(report.get("misfit"))
    if stage:
        chain = ", ".join(f"{part['name']} ({part['type']})" for part in report["parts"])
        lines.append(f"stage          {chain}")
    if report["family"] is not None:
        lines.append(
            f"density        {report['family']}, {report['levels']} levels from {report['lower_V']:g} to "
            f"{report['upper_V']:g} V"
        )
    lines += _parameters(report) if stage else _resolution(report)
    lines += ["", f"{'':14} {'samples':>8} {'e_rms':>10} {'':>12} {'e_max':>10}"]
    lines += [_row("in-sample", report["in_sample"]), _row("held-out", report["held_out"])]
    for run in report["runs"] if stage or len(report["runs"]) > 1 else ():
        lines.append(f"  {run['source']}")
        lines += [_row(f"    {key.replace('_', '-')}", run[key]) for key in ("in_sample", "held_out") if run[key]]
        if run.get("noise_um") is not None:
            steps = "" if run["substeps"] == 1 else f", {run['substeps']} steps per sample"
            lines.append(f"    residual     {_residual(run)}{steps}")
    lines += ["e_rms: root mean square error, e_max: largest error, both in % of the measured range (Eq. 35, 36)", ""]
    lines += [_loop(run) for run in report["runs"]]
    lines += ["e_loop: widest gap of the largest loop in % of its height (Eq. 34)", "", _verdict(report)]
    lines += [f"Unseen: {sentence}" for sentence in (report["unseen"] if stage else ())]
    return "\n".join(lines + [f"Note: {remark}" for remark in report["remarks"]])


def _said_of_misfit(misfit: Mapping[str, Any] | None) -> list[str]:
    """Say first how far a residual is from noise; nothing of models that were written before it was looked at."""
    if misfit is None:
        return []
    residual, noise = length(misfit["residual_um"], 4), length(misfit["noise_um"])
    figures = (
        "{residual} rms in {source}, {share_pct:.3g} % of its stroke and {times_noise:.3g} times the "
        "sensor's noise ({noise}, by {noise_shown_by})"
    ).format(residual=residual, noise=noise, **misfit)
    if not misfit["far"]:
        return [f"left over      {figures}", ""]
    return [f"FAR FROM NOISE {figures}: the model misses something, and all below is no better than that", ""]


def _resolution(report: Mapping[str, Any]) -> list[str]:
    levels = ", ".join(f"{trial['levels']:d}" for trial in report["trials"])
    per_um, unit = length_unit(min(trial["error_um"] for trial in report["trials"]))
    errors = ", ".join(f"{trial['error_um'] * per_um:.4g}" for trial in report["trials"])
    return [
        f"levels tried   {levels}",
        f"  their error  {errors} {unit}, on blocks predicted from the others",
        f"residual       {_residual(report)}",
    ]


def _residual(report: Mapping[str, Any]) -> str:
    correlation = report["correlation_samples"]
    colour = "white" if correlation <= WHITE else f"neighbours alike over {correlation:.0f} samples"
    return f"{length(report['noise_um'], 4)} standard deviation, {colour}"


def _row(name: str, errors: Mapping[str, Any] | None) -> str:
    if errors is None:
        return f"{name:14} {'none':>8}"
    return (
        f"{name:14} {errors['samples']:8d} {errors['e_rms_pct']:8.4g} % {length(errors['rms_um'], 4):>12} "
        f"{errors['e_max_pct']:8.4g} % {length(errors['max_um'], 4):>12}"
    )


def _loop(run: Mapping[str, Any]) -> str:
    measured, model = run["e_loop_measured_pct"], run["e_loop_model_pct"]
    if measured is None or model is None:
        return f"e_loop         {run['source']}: no full loop in it"
    return f"e_loop         {run['source']}: measured {measured:.4g} %, model {model:.4g} %"


def _verdict(report: Mapping[str, Any]) -> str:
    held_out, in_sample = report["held_out"], report["in_sample"]
    if held_out is None:
        return "Nothing was held out, so how well new voltages are predicted was not seen."
    ratio = held_out["rms_um"] / max(in_sample["rms_um"], 1e-300)
    misfit = report.get("misfit")
    if ratio <= _EQUAL and misfit is not None and misfit["far"]:
        return (
            f"Samples that the fit never saw are off by {held_out['e_rms_pct']:.3g} % of the range, those it did by "
            f"{in_sample['e_rms_pct']:.3g} %, where noise alone would leave "
            f"{100 * misfit['noise_um'] / in_sample['range_um']:.2g} %: the model misses the same in both."
        )
    if ratio <= _EQUAL:
        return "Samples that the fit never saw are predicted as well as those it did."
    return (
        f"Samples that the fit never saw are predicted {ratio:.3g} times worse than those it did: expect the "
        "held-out figures, not the in-sample ones."
    )


# A parameter at a bound is put 1e-6 of its scale away from it: nothing is known of one that may be ten scales away.
_AT_BOUND = 1e-7
# An interval from so small a part of the value to so many times it says nothing, nor does one of such a width.
_OPEN, _ANYTHING = 100.0, 1e9
UNSEEN, UNDETERMINED = "at its bound, not seen in these runs", "not determined by these runs"


def unseen(value: float | None, lower: float | None, upper: float | None) -> str:
    """Say that runs do not show a parameter, by its value and 95 % interval; nothing of one that they show.

    They do not show one at a bound whose interval is open on the other side, nor one that may be anything. An
    interval of less than a decade says where it is.
    """
    # In JSON an open end is none, as is one that is not known, and both of what has no interval at all.
    if value is None or (lower is None and upper is None):
        return ""
    lower, upper = -inf if lower is None else lower, inf if upper is None else upper
    if not lower <= value <= upper:
        return ""
    smaller, larger = sorted((abs(lower), abs(upper)))
    if lower == upper or (lower * upper > 0 and larger < 10 * smaller):
        return ""
    width = upper - lower
    near = _AT_BOUND * (width if width < inf else abs(value))
    # What is zero at its bound is not there, and how large it may be is told.
    if min(value - lower, upper - value) <= near and (value != 0 or width > _ANYTHING):
        return UNSEEN
    decades = 0 < lower < value / _OPEN and upper > _OPEN * value
    anything = _ANYTHING < width < inf or -lower == upper == inf
    return UNDETERMINED if decades or anything else ""


def parameter_lines(parameters: Sequence[Mapping[str, Any]]) -> list[str]:
    """A table of parameters of a report: values, standard deviations, 95 % intervals and units."""
    return columns([_parameter_row(one) for one in parameters])


def _parameter_row(one: Mapping[str, Any]) -> tuple[str, str, str, str]:
    if words := unseen(one["value"], one["lower"], one["upper"]):
        return one["name"], words, "", ""
    sd = "unknown" if one["sd"] is None else format(one["sd"], ".2g")
    interval = f"(95 % {_value(one, 'lower')}..{_value(one, 'upper')})"
    return one["name"], f"{_value(one)} ± {sd}", interval, "" if one["unit"] == "1" else one["unit"]


def _parameters(report: Mapping[str, Any]) -> list[str]:
    """A table of the parameters, and the pairs whose errors go together."""
    lines = ["", *parameter_lines(report["parameters"])]
    names = [each["name"] for each in report["parameters"]]
    for i, j in combinations(range(len(names)), 2):
        value = report["correlation"][i][j]
        if value is not None and abs(value) > 0.5:
            lines.append(f"correlated     {names[i]} and {names[j]}: {value:+.2f}")
    return lines


def _value(parameter: Mapping[str, Any], key: str = "value") -> str:
    """Write a value down to the second digit of its standard deviation."""
    value, sd = parameter[key], parameter["sd"]
    if value is None:
        return "unknown"
    if not sd or value == 0:
        return f"{value:.6g}"
    digits = floor(log10(abs(value))) - floor(log10(sd)) + 2
    return f"{value:#.{min(max(digits, 2), 10)}g}".rstrip(".")
