"""A diagnosis as JSON, and the schema that it keeps to."""

import json
import math
from importlib.resources import files
from typing import Any

import numpy as np

from fits.diagnosis._result import SCHEMA, Bound, Diagnosis, Experiment, FoundCause, Gain, RunView, Test
from fits.diagnosis._words import verdict_sentence
from fits.io._version import written_by


def diagnosis_schema() -> dict[str, Any]:
    """Read the JSON Schema (draft 2020-12) of what `diagnosis_json` gives."""
    text = files("fits.report").joinpath("diagnosis.schema.json").read_text(encoding="utf-8")
    schema: dict[str, Any] = json.loads(text)
    return schema


def diagnosis_json(diagnosis: Diagnosis) -> dict[str, Any]:
    """Turn a diagnosis into values that strict JSON can hold.

    Parameters
    ----------
    diagnosis
        From `diagnose`.

    Returns
    -------
    dict
        As `diagnosis_schema` describes it; a number that is not known is None. The samples of the runs and of the
        next program are not in it.
    """
    ahead = diagnosis.next_experiment
    return {
        "schema": SCHEMA,
        "written_by": written_by(),
        "verdict": diagnosis.verdict,
        "sentence": verdict_sentence(diagnosis),
        "false_alarm": _number(diagnosis.false_alarm),
        "noise_um": _number(diagnosis.noise_um),
        "noise_source": diagnosis.noise_source,
        "noise_samples": _number(diagnosis.noise_samples),
        "causes": [_cause(cause) for cause in diagnosis.causes],
        "unexplained_rms_um": _number(diagnosis.unexplained_rms_um),
        "upper_bounds": [_bound(bound) for bound in diagnosis.upper_bounds],
        "tests": [_test(test) for test in diagnosis.tests],
        "gain": _gain(diagnosis.gain),
        "next_experiment": None if ahead is None else _experiment(ahead),
        "remarks": list(diagnosis.remarks),
        "runs": [_run(run) for run in diagnosis.runs],
    }


def _number(value: float) -> float | None:
    number = float(value)
    return number if math.isfinite(number) else None


def _cause(cause: FoundCause) -> dict[str, Any]:
    return {
        "name": cause.name,
        "form": cause.form,
        "also_consistent": list(cause.also_consistent),
        "z": _number(cause.z),
        "p_family": _number(cause.p_family),
        "parameters": {
            each.name: {
                "value": _number(each.value),
                "sd": _number(each.sd),
                "unit": each.unit,
                "lower": _number(each.lower),
                "upper": _number(each.upper),
            }
            for each in cause.parameters
        },
        "share_of_misfit": _number(cause.share_of_misfit),
        "rms_um": _number(cause.rms_um),
        "fingerprint": cause.fingerprint,
        "experiment": cause.experiment,
        "source": cause.source,
    }


def _bound(bound: Bound) -> dict[str, Any]:
    return {
        "name": bound.name,
        "z": _number(bound.z),
        "absorbed_fraction": _number(bound.absorbed_fraction),
        "bound_um": _number(bound.bound_um),
        "reason": bound.reason,
    }


def _test(test: Test) -> dict[str, Any]:
    return {
        "name": test.name,
        "statistic": _number(test.statistic),
        "p": _number(test.p),
        "share": _number(test.share),
        "sentence": test.sentence,
    }


def _gain(gain: Gain) -> dict[str, Any]:
    sizes = {name: _number(value) for name, value in vars(gain).items() if name.endswith("_um")}
    return {**sizes, "source": gain.source}


def _experiment(ahead: Experiment) -> dict[str, Any]:
    known = ahead.time_s.size > 0
    return {
        "kind": ahead.kind,
        "purpose": ahead.purpose,
        "separates": list(ahead.separates),
        "predicted_z": _number(ahead.predicted_z),
        "present_z": _number(ahead.present_z),
        "extra_column": ahead.extra_column,
        "samples": int(ahead.time_s.size),
        "duration_s": _number(ahead.time_s[-1] - ahead.time_s[0]) if known else None,
        "lowest_V": _number(ahead.voltage_V.min()) if known else None,
        "highest_V": _number(ahead.voltage_V.max()) if known else None,
        "extremes": [
            {
                "quantity": one.name,
                "unit": one.unit,
                **{key: _number(getattr(one, key)) for key in ("low", "high", "lowest", "highest")},
            }
            for one in ahead.extremes
        ],
    }


def _run(run: RunView) -> dict[str, Any]:
    known = run.time_s.size > 0
    return {
        "source": run.source,
        "samples": int(run.time_s.size),
        "fitted_samples": int(np.count_nonzero(run.fitted)),
        "duration_s": _number(run.time_s[-1] - run.time_s[0]) if known else None,
        "rms_before_um": _number(_rms(run.before_um[run.fitted])),
        "rms_after_um": _number(_rms(run.after_um[run.fitted])),
    }


def _rms(values: np.ndarray) -> float:
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known**2))) if known.size else math.nan
