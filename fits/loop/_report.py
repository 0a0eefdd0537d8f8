"""The fit of a hysteresis or a stage in JSON values."""

from typing import TYPE_CHECKING, Any

import numpy as np

from fits.io._json import strict
from fits.io._limits import ranges_json
from fits.loop._misfit import Misfit
from fits.stats._metrics import Errors
from microid import Preisach, Stage, innermost

if TYPE_CHECKING:
    from fits.loop._result import FitResult, RunReport


def fit_report(result: "FitResult[Any]") -> dict[str, Any]:
    """Put what is known of a fit into JSON values, kept under `fit` in model files; what does not exist is None."""
    model, law = result.model, preisach_of(result.model)
    parts: dict[str, Any] = {}
    if isinstance(model, Stage):
        named = zip(model.names, model.parts, strict=True)
        parts["parts"] = [{"name": name, "type": type(part).__name__} for name, part in named]
        known = {name: strict(getattr(result, name)) for name in ("parameters", "correlation", "unseen")}
    else:
        known = {name: getattr(result, name) for name in ("noise_um", "correlation_samples", "smoothness")}
        known["trials"] = [dict(vars(trial)) for trial in result.trials]
    grid = dict.fromkeys(("family", "levels", "lower_V", "upper_V"))
    if law is not None:
        lower, upper = float(law.density.lower_V), float(law.density.upper_V)
        grid = {"family": law.density.family, "levels": law.density.levels, "lower_V": lower, "upper_V": upper}
    return {
        "status": result.status.name.lower(),
        **parts,
        **grid,
        **known,
        "misfit": _misfit(result.misfit),
        "discrepancy_um": float(result.uncertainty.discrepancy_um),
        "in_sample": _errors(result.in_sample),
        "held_out": _errors(result.held_out),
        "runs": [_run(run, isinstance(model, Stage)) for run in result.runs],
        "remarks": [remark for remark in result.remarks if remark not in result.unseen],
    }


def preisach_of(model: Preisach | Stage) -> Preisach | None:
    """The Preisach operator that a model is, or has among its parts; None where there is none."""
    parts = [model] if isinstance(model, Preisach) else map(innermost, model.parts)
    return next((part for part in parts if isinstance(part, Preisach)), None)


def _misfit(misfit: Misfit | None) -> dict[str, Any] | None:
    if misfit is None:
        return None
    found = {**vars(misfit), "times_noise": misfit.times_noise, "far": misfit.far}
    return {"noise_shown_by" if name == "shown_by" else name: value for name, value in found.items()}


def _errors(errors: Errors | None) -> dict[str, Any] | None:
    if errors is None:
        return None
    return {**vars(errors), "e_rms_pct": errors.e_rms_pct, "e_max_pct": errors.e_max_pct}


def _run(run: "RunReport", of_stage: bool) -> dict[str, Any]:
    # Of a run of a stage; None where it was not fitted.
    more = ("noise_um", "correlation_samples", "substeps") if of_stage else ()
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
        **{key: getattr(run, key) for key in more},
    }
