"""The command `microid fit`: the work."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click

from fits.cli._files import fraction_or_files, keep_inputs, progress_to_stderr
from fits.io._atomic import finite_json
from fits.io._errors import DataError
from fits.io._file_set import file_set
from fits.io._jax_setup import start_jax
from fits.io._read_csv import read_csv, read_runs
from fits.io._units import parse_columns
from fits.loop._fit import fit
from fits.loop._result import FitError
from fits.plots._loop import plot_fit
from fits.plots._stage import plot_stage
from fits.report._loop import describe, fit_report
from fits.report._stage import describe_stage, stage_report
from fits.stage._fit import default_stage, fit_stage
from fits.stage._model_file import model_text
from microid import Hold

_HOLDS: dict[str, Hold] = {"lines": "first", "steps": "zero", "curves": "smooth"}


@dataclass(frozen=True)
class _Kind:
    """What can be fitted: how, and how to show it."""

    fit: Callable[..., Any]
    report: Callable[[Any], dict[str, Any]]
    describe: Callable[[dict[str, Any]], str]
    plot: Callable[..., Sequence[Path]]


def run_fit(
    *,
    model: str,
    runs: Sequence[str],
    out: str,
    plots: str | None,
    family: str | None,
    levels: int | None,
    loss: str | None,
    hold: str | None,
    holdout: Sequence[str],
    columns: str,
    initial: Sequence[str],
    starts: int | None,
    seed: int | None,
    as_json: bool,
    quiet: bool,
) -> None:
    """Do `microid fit`; the options are the command's."""
    start_jax()
    states: str | list[str]
    options: dict[str, Any]
    if model == "stage":
        kind = _Kind(fit_stage, stage_report, describe_stage, plot_stage)
        states, options = _stage_options(family, starts, seed, loss, hold, initial, len(runs))
    else:
        kind = _Kind(fit, fit_report, describe, plot_fit)
        states, options = _loop_options(family, starts, seed, loss, hold, initial)
    progress = progress_to_stderr(quiet)
    mapping = parse_columns(columns)
    fraction, files = fraction_or_files(holdout)
    keep_inputs(out, [*runs, *files])
    # Entered before the fit, so that a place that cannot be written to is refused before the wait.
    with file_set() as made:
        unfinished, drawings = made.file(out), made.folder(plots)
        records = read_runs(runs, mapping)
        aside = [read_csv(file, mapping) for file in files]
        left_out = aside or fraction
        try:
            result = kind.fit(records, levels=levels, holdout=left_out, initial=states, progress=progress, **options)
        except FitError as error:
            raise DataError(f"{error}.") from error
        report = kind.report(result)
        drawn: Sequence[Path] = ()
        if drawings is not None:
            progress("drawing")
            drawn = kind.plot(result, records, drawings, holdout=left_out, initial=states)
        unfinished.write_text(model_text(result.model, result.uncertainty, report), encoding="utf-8")
    places = [str(Path(plots) / path.name) for path in drawn] if plots else []
    if as_json:
        click.echo(finite_json({"out": out, "plots": places, **report}))
    else:
        click.echo("\n".join([kind.describe(report), "", f"model  {out}", *(f"plot   {place}" for place in places)]))


def _loop_options(
    family: str | None,
    starts: int | None,
    seed: int | None,
    loss: str | None,
    hold: str | None,
    initial: Sequence[str],
) -> tuple[str, dict[str, Any]]:
    """Memory before all runs, and the options of `fit`; what it cannot honour is refused."""
    if hold is not None:
        raise DataError(f"--hold {hold}: only the fit of a stage has a choice; leave it out, or use --model stage.")
    if len(initial) > 1:
        raise DataError(
            f"--initial: expected one state for all runs, found {len(initial)}; give one, or use --model stage."
        )
    return (initial[0] if initial else "unknown"), {
        "family": family or "grid",
        "loss": loss or "squares",
        "starts": starts or 8,
        "seed": seed or 0,
    }


def _stage_options(
    family: str | None,
    starts: int | None,
    seed: int | None,
    loss: str | None,
    hold: str | None,
    initial: Sequence[str],
    count: int,
) -> tuple[str | list[str], dict[str, Any]]:
    """Memory before all runs or before each, and the options of `fit_stage`; what it cannot honour is refused."""
    if family not in (None, "grid"):
        raise DataError(
            f"--family {family}: the hysteresis of a stage is fitted on a grid; leave out --family, or use "
            "--model loop."
        )
    for name, value in (("starts", starts), ("seed", seed)):
        if value is not None:
            raise DataError(
                f"--{name} {value}: a stage starts from what the runs show, not at random; leave out --{name}, or "
                "use --model loop."
            )
    if len(initial) not in (0, 1, count):
        raise DataError(
            f"--initial: {len(initial)} states were given for {count} runs; give one for all, or one for each in "
            "their order."
        )
    states = (initial[0] if initial else "unknown") if len(initial) < 2 else list(initial)
    stage = default_stage(_HOLDS[hold or "lines"])
    return states, {"loss": loss or "squares", "stage": stage}
