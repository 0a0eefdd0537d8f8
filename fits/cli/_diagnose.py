"""The command `microid diagnose`: the work."""

import json
import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fits.cli._files import bar_to_stderr, fraction_or_files, keep_inputs
from fits.diagnosis._steps import Step
from fits.io._atomic import write_csv
from fits.io._errors import DataError
from fits.io._file_set import file_set
from fits.io._jax_setup import start_jax
from fits.io._limits import parse_limits, ranges_json
from fits.io._places import usable_folder
from fits.io._read_csv import read_csv, read_runs
from fits.io._units import parse_columns
from fits.loop._result import FitError

if TYPE_CHECKING:
    from fits.diagnosis._result import Diagnosis, EffectParameter

_REPORT, _JSON, _BASELINE, _EXTENDED = "report.html", "diagnosis.json", "baseline.json", "extended.json"
_PROGRAM = "next_experiment.csv"
_LONGEST_s = 1e5
_WIDEST = 10.0
_FILES = (_REPORT, _JSON, _BASELINE, _EXTENDED, _PROGRAM)


def run_diagnose(
    *,
    runs: Sequence[str],
    out: str,
    holdout: Sequence[str],
    false_alarm: float,
    duration: float | None,
    initial: str,
    limit: Sequence[str],
    margin: float,
    columns: str,
    as_json: bool,
    quiet: bool,
) -> None:
    """Do `microid diagnose`; the options are the command's."""
    if not 0 < false_alarm <= 0.5:
        raise DataError(f"--false-alarm: expected a probability above 0 and up to 0.5, found {false_alarm:g}.")
    if duration is not None and not 0 < duration <= _LONGEST_s:
        raise DataError(f"--duration: expected a time above 0 and up to {_LONGEST_s:g} s, found {duration:g}.")
    if not 0 <= margin <= _WIDEST:
        raise DataError(f"--margin: expected a share of the ranges reached, 0 to {_WIDEST:g}, found {margin:g}.")
    limits = parse_limits(limit)
    mapping = parse_columns(columns)
    fraction, files = fraction_or_files(holdout)
    for name in _FILES:
        keep_inputs(os.path.join(out, name), [*runs, *files])
    # Before the work, so that a place that cannot be written to is refused before the wait.
    usable_folder(out, "--out")
    start_jax()
    progress = bar_to_stderr(quiet, tuple(Step))
    records = read_runs(runs, mapping)
    aside = [read_csv(file, mapping) for file in files]
    # Not before the files are read: this takes as long as all that.
    from fits.diagnosis._diagnose import diagnose

    try:
        diagnosis: Diagnosis = diagnose(
            records,
            holdout=aside or fraction,
            false_alarm=false_alarm,
            duration_s=duration,
            initial=initial,
            limits=limits,
            margin=margin,
            progress=progress,
        )
    except FitError as error:
        raise DataError(f"{error}.") from error
    progress(Step.WRITING)
    from fits.report._diagnosis_json import diagnosis_json

    content = diagnosis_json(diagnosis)
    places = _write(diagnosis, content, out)
    if as_json:
        click.echo(json.dumps({"out": out, "files": places, **content}, indent=1, allow_nan=False))
    else:
        click.echo("\n".join([*_lines(diagnosis), "", *places]))


def _write(diagnosis: "Diagnosis", content: dict[str, Any], out: str) -> list[str]:
    """Write all files, or none; their names come back."""
    from fits.report._diagnosis import report_html
    from fits.stage._model_file import model_text

    def model(which: str) -> str:
        stage = diagnosis.baseline if which == "baseline" else diagnosis.extended
        # What is not known is not in the file.
        uncertainty: Any = diagnosis.details.get(f"{which}_uncertainty")
        try:
            # Their own displacement is without an offset.
            runs = [{"offset_um": 0.0, "reached": ranges_json(one)} for one in diagnosis.details.get("reached", ())]
            about = {"part_of": "diagnosis", "stage": which, "runs": runs}
            return model_text(stage, uncertainty, about)
        except DataError as error:
            raise DataError(f"{os.path.join(out, which)}.json: the model cannot be written: {error}.") from error

    # All are composed before the first is written.
    texts = {
        _REPORT: report_html(diagnosis),
        _JSON: json.dumps(content, indent=1, allow_nan=False) + "\n",
        _BASELINE: model("baseline"),
        _EXTENDED: model("extended"),
    }
    ahead = diagnosis.next_experiment
    with file_set() as files:
        place = files.folder(out, "--out")
        for name, text in texts.items():
            (place / name).write_text(text, encoding="utf-8")
        if ahead is not None:
            said = [f"predicted {one}" for one in ahead.extremes]
            write_csv(place / _PROGRAM, {"time_s": ahead.time_s, "voltage_V": ahead.voltage_V}, said)
        else:
            # One of an earlier diagnosis would pass for this one's.
            files.absent(Path(out) / _PROGRAM)
    return [str(Path(out) / name) for name in (*texts, *([_PROGRAM] if ahead is not None else []))]


def _lines(diagnosis: "Diagnosis") -> list[str]:
    """What a terminal shows: the verdict, the causes with their parameters, and the gain."""
    found = {"no_effect": "no effect found", "effect_found": "effect found", "unexplained": "unexplained error"}
    lines = [f"{found[diagnosis.verdict]}; noise {diagnosis.noise_um:.3g} um, {diagnosis.noise_source}"]
    for cause in diagnosis.causes:
        also = f", or {', '.join(cause.also_consistent)}" if cause.also_consistent else ""
        lines.append(f"  {cause.name}{also}: {cause.z:.3g} standard deviations, by chance {cause.p_family:.1g}")
        if math.isfinite(cause.rms_um) and math.isfinite(cause.share_of_misfit):
            lines.append(f"    {cause.rms_um:.3g} um, {100 * cause.share_of_misfit:.0f} % of the misfit")
        lines += [_parameter(each) for each in cause.parameters]
    if diagnosis.unexplained_rms_um > 0:
        lines.append(f"  unexplained: {diagnosis.unexplained_rms_um:.3g} um")
    gain = diagnosis.gain
    if math.isfinite(gain.heldout_rms_before_um):
        line = f"error on held-out data: {gain.heldout_rms_before_um:.3g} um"
        if diagnosis.causes and math.isfinite(gain.heldout_rms_after_um):
            line += f" without, {gain.heldout_rms_after_um:.3g} um with what was found"
        lines.append(line)
    if diagnosis.next_experiment is not None:
        lines.append(f"next experiment: {diagnosis.next_experiment.purpose}")
    return [*lines, *(f"Note: {remark}" for remark in diagnosis.remarks)]


def _parameter(parameter: "EffectParameter") -> str:
    unit = "" if parameter.unit == "1" else f" {parameter.unit}"
    return f"    {parameter.name:24} {parameter.value:.4g} +- {parameter.sd:.2g}{unit}"
