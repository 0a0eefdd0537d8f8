"""A fit in JSON values and in words."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from fits.io._limits import ranges_json
from fits.loop._misfit import Misfit
from fits.loop._result import FitResult, RunReport
from fits.stats._metrics import Errors

# Held-out errors up to this many times the fitted ones count as equal.
_EQUAL = 1.1


def fit_report(result: FitResult) -> dict[str, Any]:
    """Put what is known of a fit into JSON values.

    Returns
    -------
    dict
        What a model file keeps under `fit`. Errors that do not exist are None.
    """
    density = result.model.density
    return {
        "status": result.status.name.lower(),
        "family": density.family,
        "levels": density.levels,
        "lower_V": float(density.lower_V),
        "upper_V": float(density.upper_V),
        "noise_um": result.noise_um,
        "correlation_samples": result.correlation_samples,
        "discrepancy_um": float(result.uncertainty.discrepancy_um),
        "smoothness": result.smoothness,
        "trials": [{"levels": trial.levels, "error_um": trial.error_um} for trial in result.trials],
        "misfit": misfit_report(result.misfit),
        "in_sample": _errors(result.in_sample),
        "held_out": _errors(result.held_out),
        "runs": [_run(run) for run in result.runs],
        "remarks": list(result.remarks),
    }


def misfit_report(misfit: Misfit | None) -> dict[str, Any] | None:
    """Put how far a residual is from noise into JSON values."""
    if misfit is None:
        return None
    return {
        "source": misfit.source,
        "residual_um": misfit.residual_um,
        "share_pct": misfit.share_pct,
        "noise_um": misfit.noise_um,
        "noise_shown_by": misfit.shown_by,
        "times_noise": misfit.times_noise,
        "far": misfit.far,
    }


def describe_misfit(misfit: Mapping[str, Any] | None) -> list[str]:
    """Say first how far a residual is from noise; nothing of models that were written before it was looked at."""
    if misfit is None:
        return []
    figures = (
        f"{misfit['residual_um']:.4g} um rms in {misfit['source']}, {misfit['share_pct']:.3g} % of its stroke and "
        f"{misfit['times_noise']:.3g} times the sensor's noise ({misfit['noise_um']:.3g} um, by "
        f"{misfit['noise_shown_by']})"
    )
    if not misfit["far"]:
        return [f"left over      {figures}", ""]
    return [f"FAR FROM NOISE {figures}: the model misses something, and all below is no better than that", ""]


def _errors(errors: Errors | None) -> dict[str, Any] | None:
    if errors is None:
        return None
    return {
        "samples": errors.samples,
        "rms_um": errors.rms_um,
        "max_um": errors.max_um,
        "range_um": errors.range_um,
        "e_rms_pct": errors.e_rms_pct,
        "e_max_pct": errors.e_max_pct,
    }


def _run(run: RunReport) -> dict[str, Any]:
    return {
        "source": run.source,
        "offset_um": run.offset_um,
        "in_sample": _errors(run.in_sample),
        "held_out": _errors(run.held_out),
        "unknown_samples": run.unknown,
        "start_extremes_V": np.asarray(run.start.extremes_V)[: int(run.start.count)].tolist(),
        "e_loop_measured_pct": run.loop_measured_pct,
        "e_loop_model_pct": run.loop_model_pct,
        "reached": ranges_json(run.reached),
    }


def describe(report: Mapping[str, Any]) -> str:
    """Put a report into words: some twenty lines, without a newline at the end."""
    trials = report["trials"]
    lines = [
        *describe_misfit(report.get("misfit")),
        f"density        {report['family']}, {report['levels']} levels from {report['lower_V']:g} to "
        f"{report['upper_V']:g} V",
        f"levels tried   {_joined(trials, 'levels', 'd')}",
        f"  their error  {_joined(trials, 'error_um', '.4g')} um, on blocks predicted from the others",
        f"residual       {report['noise_um']:.4g} um standard deviation, {_colour(report['correlation_samples'])}",
        "",
        f"{'':14} {'samples':>8} {'e_rms':>10} {'':>12} {'e_max':>10}",
        _row("in-sample", report["in_sample"]),
        _row("held-out", report["held_out"]),
    ]
    if len(report["runs"]) > 1:
        for run in report["runs"]:
            lines.append(f"  {run['source']}")
            lines += [_row(f"    {key.replace('_', '-')}", run[key]) for key in ("in_sample", "held_out") if run[key]]
    lines += ["e_rms: root mean square error, e_max: largest error, both in % of the measured range (Eq. 35, 36)", ""]
    lines += [_loop(run) for run in report["runs"]]
    lines += ["e_loop: widest gap of the largest loop in % of its height (Eq. 34)", "", _verdict(report)]
    return "\n".join(lines + [f"Note: {remark}" for remark in report["remarks"]])


def _joined(trials: Sequence[Mapping[str, Any]], key: str, form: str) -> str:
    return ", ".join(format(trial[key], form) for trial in trials)


def _colour(correlation: float) -> str:
    return "white" if correlation <= 1.2 else f"neighbours alike over {correlation:.0f} samples"


def _row(name: str, errors: Mapping[str, Any] | None) -> str:
    if errors is None:
        return f"{name:14} {'none':>8}"
    return (
        f"{name:14} {errors['samples']:8d} {errors['e_rms_pct']:8.4g} % {errors['rms_um']:9.4g} um "
        f"{errors['e_max_pct']:8.4g} % {errors['max_um']:9.4g} um"
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
