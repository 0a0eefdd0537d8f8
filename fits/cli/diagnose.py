"""The command `microid diagnose`: its options, and the work."""

import os
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import click

from fits.cli import _common as common
from fits.cli import _late as late
from fits.cli import _options as options
from fits.io._errors import DataError
from fits.io._file_set import file_set, usable_folder

_REPORT, _JSON, _BASELINE, _EXTENDED = "report.html", "diagnosis.json", "baseline.json", "extended.json"
_PROGRAM = "next_experiment.csv"
_LONGEST_s = 1e5


@click.command()
@options.runs
@options.out_folder
@options.holdout("What is only predicted, as for fit (default 0.2).")
@click.option(
    "--false-alarm", type=float, default=0.01, show_default=True, help="Chance of a cause where there is none."
)
@click.option(
    "--budget",
    type=float,
    metavar="SECONDS",
    default=300.0,
    show_default=True,
    help="For all of it; the last third refines the answer.",
)
@click.option("--duration", type=float, metavar="SECONDS", help="Of the next experiment, at most.")
@options.initial("all runs", "unknown")
@options.limit
@options.margin
@options.columns
@options.json_output
@common.in_sentences
def diagnose(given: common.Given) -> None:
    """Say what a fitted stage gets wrong, which physical effect causes it, and what to measure next.

    Writes report.html, diagnosis.json, the plain and the extended stage, and the voltages of the next experiment.
    Name the runs in the order in which they were taken. A column that begins with temp, and one of a second axis in
    um, nm, mm or m, are used. The end of every run is kept aside to check what is found.
    """
    if not 0 < given.false_alarm <= 0.5:
        raise DataError(f"--false-alarm: expected a probability above 0 and up to 0.5, found {given.false_alarm:g}.")
    for option, time_s in (("--budget", given.budget), ("--duration", given.duration)):
        if time_s is not None and not 0 < time_s <= _LONGEST_s:
            raise DataError(f"{option}: expected a time above 0 and up to {_LONGEST_s:g} s, found {time_s:g}.")
    if not 0 <= given.margin <= 10:
        raise DataError(f"--margin: expected a share of the ranges reached, 0 to 10, found {given.margin:g}.")
    limits, how = late.parse_limits(given.limit), common.reading(given)
    fraction, files = common.fraction_or_files(given.holdout)
    for name in (_REPORT, _JSON, _BASELINE, _EXTENDED, _PROGRAM):
        common.refuse_overwriting(os.path.join(given.out, name), [*given.runs, *files])
    usable_folder(given.out)
    records = late.read_runs(given.runs, **how)
    aside = [late.read_table(file, **how) for file in files]
    # Only now, so that what cannot be read is refused at once.
    late.start_jax()
    progress = common.progress_to_stderr(given.quiet, tuple(late.Step))
    diagnosis = late.diagnose(
        records,
        holdout=aside or fraction,
        false_alarm=given.false_alarm,
        duration_s=given.duration,
        initial=given.initial,
        limits=limits,
        margin=given.margin,
        budget_s=given.budget,
        progress=progress,
    )
    progress(late.Step.WRITING)
    content = late.diagnosis_json(diagnosis)
    places = _write(diagnosis, content, given.out, [*given.runs, *files])
    common.print_result(given, {"out": given.out, "files": places, **content}, [diagnosis.summary(), "", *places])


def _write(diagnosis: "late.Diagnosis", content: dict[str, Any], out: str, read: list[str]) -> list[str]:
    """Write all files, or none, of runs that were read from files; the names of what is written come back."""

    def model(which: str) -> str:
        stage = diagnosis.baseline if which == "baseline" else diagnosis.extended
        try:
            # Their own displacement is without an offset.
            reached = [late.ranges_json(one) for one in diagnosis.details.get("reached", ())]
            runs = [{"offset_um": 0.0, "reached": one} for one in reached]
            known = late.strict(getattr(diagnosis, f"{which}_parameters"))
            about: dict[str, Any] = {"part_of": "diagnosis", "stage": which, "parameters": known, "runs": runs}
            about["sources"] = [run.source for run in diagnosis.runs]
            return late.model_text(stage, getattr(diagnosis, f"{which}_uncertainty"), about)
        except DataError as error:
            raise DataError(f"{os.path.join(out, which)}.json: the model cannot be written: {error}.") from error

    # All are composed before the first is written.
    page = late.report_html(diagnosis, f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC", read)
    texts = {_REPORT: page, _JSON: f"{late.finite_json(content)}\n"}
    texts |= {_BASELINE: model("baseline"), _EXTENDED: model("extended")}
    ahead = diagnosis.next_experiment
    with file_set() as files:
        place = files.folder(out)
        for name, text in texts.items():
            (place / name).write_text(text, encoding="utf-8")
        if ahead is not None:
            said = [f"predicted {one}" for one in ahead.extremes]
            late.write_csv(place / _PROGRAM, {"time_s": ahead.time_s, "voltage_V": ahead.voltage_V}, said)
        else:
            # One of an earlier diagnosis would pass for this one's.
            files.absent(Path(out) / _PROGRAM)
    return common.paths_in(out, [*texts, *([_PROGRAM] if ahead is not None else [])])
