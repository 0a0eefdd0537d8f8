"""The fit of a stage in JSON values and in words."""

from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import Any

import numpy as np

from fits.report._loop import _colour, _errors, _loop, _row, _run, _verdict, describe_misfit, misfit_report
from fits.stage._result import StageFit
from fits.stage._run import place_of_hysteresis
from microid import Preisach

# Correlations between parameters from here on are worth a line.
_WORTH_SAYING = 0.5


def stage_report(result: StageFit) -> dict[str, Any]:
    """Put what is known of the fit of a stage into JSON values.

    Returns
    -------
    dict
        What a model file keeps under `fit`. Errors and limits that do not exist are None.
    """
    place = place_of_hysteresis(result.model)
    law = None if place is None else result.model.parts[place]
    density = law.density if isinstance(law, Preisach) else None
    own = zip(result.noise_um, result.correlation_samples, result.substeps, strict=True)
    figures: list[dict[str, Any]] = [
        {"noise_um": noise, "correlation_samples": correlation, "substeps": substeps}
        for noise, correlation, substeps in own
    ]
    # Runs that were not fitted have errors, and nothing else.
    figures += [dict.fromkeys(("noise_um", "correlation_samples", "substeps"))] * (len(result.runs) - len(figures))
    return {
        "status": result.status.name.lower(),
        "parts": [
            {"name": name, "type": type(part).__name__}
            for name, part in zip(result.model.names, result.model.parts, strict=True)
        ],
        "family": None if density is None else density.family,
        "levels": None if density is None else density.levels,
        "lower_V": None if density is None else float(density.lower_V),
        "upper_V": None if density is None else float(density.upper_V),
        "parameters": [
            {
                "name": parameter.name,
                "unit": parameter.unit,
                **{key: _finite(getattr(parameter, key)) for key in ("value", "sd", "lower", "upper")},
            }
            for parameter in result.parameters
        ],
        "correlation": [[_finite(value) for value in row] for row in np.asarray(result.correlation)],
        "unseen": list(result.unseen),
        "misfit": misfit_report(result.misfit),
        "discrepancy_um": float(result.uncertainty.discrepancy_um),
        "in_sample": _errors(result.in_sample),
        "held_out": _errors(result.held_out),
        "runs": [_run(run) | more for run, more in zip(result.runs, figures, strict=True)],
        "remarks": [remark for remark in result.remarks if remark not in result.unseen],
    }


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def describe_stage(report: Mapping[str, Any]) -> str:
    """Put a report from `stage_report` into words: some thirty lines, without a newline at the end."""
    chain = ", ".join(f"{part['name']} ({part['type']})" for part in report["parts"])
    lines = [*describe_misfit(report.get("misfit")), f"stage          {chain}"]
    if report["family"] is not None:
        lines.append(
            f"density        {report['family']}, {report['levels']} levels from {report['lower_V']:g} to "
            f"{report['upper_V']:g} V"
        )
    lines += ["", *_table(report["parameters"])]
    lines += _alike(report["parameters"], report["correlation"])
    lines += ["", f"{'':14} {'samples':>8} {'e_rms':>10} {'':>12} {'e_max':>10}"]
    lines += [_row("in-sample", report["in_sample"]), _row("held-out", report["held_out"])]
    for run in report["runs"]:
        lines.append(f"  {run['source']}")
        lines += [_row(f"    {key.replace('_', '-')}", run[key]) for key in ("in_sample", "held_out") if run[key]]
        if run["noise_um"] is not None:
            lines.append(f"    residual     {_residual(run)}")
    lines += ["e_rms: root mean square error, e_max: largest error, both in % of the measured range (Eq. 35, 36)", ""]
    lines += [_loop(run) for run in report["runs"]]
    lines += ["e_loop: widest gap of the largest loop in % of its height (Eq. 34)", "", _verdict(report)]
    lines += [f"Unseen: {sentence}" for sentence in report["unseen"]]
    return "\n".join(lines + [f"Note: {remark}" for remark in report["remarks"]])


def _table(parameters: Sequence[Mapping[str, Any]]) -> list[str]:
    rows = [(each["name"], f"{_value(each)} ± {_sd(each)}", _interval(each), each["unit"]) for each in parameters]
    widths = [max((len(row[column]) for row in rows), default=0) for column in range(3)]
    return [
        f"{name:{widths[0]}}  {value:{widths[1]}}  {interval:{widths[2]}}  {'' if unit == '1' else unit}".rstrip()
        for name, value, interval, unit in rows
    ]


def _value(parameter: Mapping[str, Any]) -> str:
    """Write a value down to the second digit of its standard deviation."""
    return _to_the_digit(parameter["value"], parameter["sd"])


def _sd(parameter: Mapping[str, Any]) -> str:
    return "unknown" if parameter["sd"] is None else f"{parameter['sd']:.2g}"


def _interval(parameter: Mapping[str, Any]) -> str:
    ends = [
        "unknown" if parameter[key] is None else _to_the_digit(parameter[key], parameter["sd"])
        for key in ("lower", "upper")
    ]
    return f"(95 % {ends[0]}..{ends[1]})"


def _to_the_digit(value: float | None, sd: float | None) -> str:
    if value is None:
        return "unknown"
    if not sd or value == 0:
        return f"{value:.6g}"
    digits = int(np.floor(np.log10(abs(value)))) - int(np.floor(np.log10(sd))) + 2
    return f"{value:#.{min(max(digits, 2), 10)}g}".rstrip(".")


def _alike(parameters: Sequence[Mapping[str, Any]], correlation: Sequence[Sequence[float | None]]) -> list[str]:
    """Name the pairs of parameters whose errors go together."""
    found = [
        (one["name"], other["name"], correlation[i][j])
        for (i, one), (j, other) in combinations(enumerate(parameters), 2)
    ]
    return [
        f"correlated     {one} and {other}: {value:+.2f}"
        for one, other, value in found
        if value is not None and abs(value) > _WORTH_SAYING
    ]


def _residual(run: Mapping[str, Any]) -> str:
    steps = "" if run["substeps"] == 1 else f", {run['substeps']} steps per sample"
    return f"{run['noise_um']:.4g} um standard deviation, {_colour(run['correlation_samples'])}{steps}"
