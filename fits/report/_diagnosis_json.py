"""A diagnosis as JSON, and the schema that it keeps to."""

import json
from collections.abc import Sequence
from importlib.resources import files
from typing import Any

import numpy as np

from fits.diagnosis._result import SCHEMA, Diagnosis, Experiment, RunView
from fits.io._json import strict
from fits.io._version import written_by
from fits.loop._result import ParameterEstimate
from fits.report._words import rms_um, verdict_sentence


def diagnosis_schema() -> dict[str, Any]:
    """Read the JSON Schema (draft 2020-12) of what `diagnosis_json` gives."""
    text = files("fits.report").joinpath("diagnosis.schema.json").read_text(encoding="utf-8")
    return dict(json.loads(text))


def diagnosis_json(diagnosis: Diagnosis) -> dict[str, Any]:
    """Turn a diagnosis into values that strict JSON can hold, as `diagnosis_schema` describes them.

    A number that is not known is None. The samples of the runs and of the next program are left out.
    """
    ahead = diagnosis.next_experiment
    noise = ("false_alarm", "noise_um", "noise_source", "noise_samples")
    kept = ("unexplained_rms_um", "upper_bounds", "tests", "gain")
    found = {
        "schema": SCHEMA,
        "written_by": written_by(),
        "verdict": diagnosis.verdict,
        "sentence": verdict_sentence(diagnosis),
        **{name: getattr(diagnosis, name) for name in noise},
        "causes": [vars(cause) | {"parameters": _by_name(cause.parameters)} for cause in diagnosis.causes],
        "baseline_parameters": _by_name(diagnosis.baseline_parameters),
        "extended_parameters": _by_name(diagnosis.extended_parameters),
        "residual_rms_before_um": rms_um(diagnosis.runs, "before_um"),
        "residual_rms_after_um": rms_um(diagnosis.runs, "after_um"),
        **{name: getattr(diagnosis, name) for name in kept},
        "next_experiment": None if ahead is None else _experiment(ahead),
        "remarks": diagnosis.remarks,
        "runs": [_run(run) for run in diagnosis.runs],
    }
    return dict(strict(found))


def _by_name(parameters: Sequence[ParameterEstimate]) -> dict[str, Any]:
    each = [dict(vars(one)) for one in parameters]
    return {one.pop("name"): one for one in each}


def _experiment(ahead: Experiment) -> dict[str, Any]:
    kept = ("kind", "purpose", "separates", "predicted_z", "present_z", "extra_column")
    known, ends = ahead.time_s.size > 0, ("unit", "low", "high", "lowest", "highest")
    return {
        **{name: getattr(ahead, name) for name in kept},
        "samples": int(ahead.time_s.size),
        "duration_s": np.ptp(ahead.time_s) if known else None,
        "lowest_V": ahead.voltage_V.min() if known else None,
        "highest_V": ahead.voltage_V.max() if known else None,
        "extremes": [{"quantity": one.name} | {key: getattr(one, key) for key in ends} for one in ahead.extremes],
    }


def _run(run: RunView) -> dict[str, Any]:
    return {
        "source": run.source,
        "samples": int(run.time_s.size),
        "fitted_samples": int(np.count_nonzero(run.fitted)),
        "duration_s": np.ptp(run.time_s) if run.time_s.size else None,
        "rms_before_um": rms_um([run], "before_um"),
        "rms_after_um": rms_um([run], "after_um"),
    }
