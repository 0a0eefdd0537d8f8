"""The command `microid fit --model stage`, and what other commands do with a whole stage: the work."""

import json
from collections.abc import Sequence
from pathlib import Path

import click

from fits._atomic import atomic_path
from fits._cli_jax import start_jax
from fits._cli_work import _folder, _holdout, _keep_inputs, _progress
from fits._errors import DataError
from fits._fit_stage import fit_stage
from fits._model_file import model_text
from fits._plot_stage import plot_stage
from fits._read_csv import read_csv, read_runs
from fits._result import FitError
from fits._stage_report import describe_stage, stage_report
from fits._units import parse_columns


def run_fit_stage(
    *,
    runs: Sequence[str],
    out: str,
    plots: str | None,
    family: str | None,
    levels: int | None,
    loss: str | None,
    holdout: Sequence[str],
    columns: str,
    initial: Sequence[str],
    starts: int | None,
    seed: int | None,
    as_json: bool,
    quiet: bool,
) -> None:
    """Do `microid fit --model stage`; the options are the command's."""
    start_jax()
    _refuse(family, starts, seed)
    states = _states(initial, len(runs))
    progress = _progress(quiet)
    mapping = parse_columns(columns)
    fraction, files = _holdout(holdout)
    _keep_inputs(out, [*runs, *files])
    # Entered before the fit, so that a place that cannot be written to is refused before the wait.
    with atomic_path(out) as unfinished, _folder(plots) as drawings:
        records = read_runs(runs, mapping)
        aside = [read_csv(file, mapping) for file in files]
        left_out = aside or fraction
        try:
            result = fit_stage(
                records,
                levels=levels,
                holdout=left_out,
                initial=states,
                loss=loss or "squares",
                progress=progress,
            )
        except FitError as error:
            raise DataError(f"{error}.") from error
        report = stage_report(result)
        drawn = []
        if drawings is not None:
            progress("drawing")
            drawn = plot_stage(result, records, drawings(), holdout=left_out, initial=states)
        unfinished.write_text(model_text(result.model, result.uncertainty, report), encoding="utf-8")
    places = [str(Path(plots) / path.name) for path in drawn] if plots else []
    if as_json:
        click.echo(json.dumps({"out": out, "plots": places, **report}, indent=1, allow_nan=False))
    else:
        click.echo("\n".join([describe_stage(report), "", f"model  {out}", *(f"plot   {place}" for place in places)]))


def _refuse(family: str | None, starts: int | None, seed: int | None) -> None:
    """Refuse what the fit of a stage cannot honour."""
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


def _states(initial: Sequence[str], count: int) -> str | list[str]:
    """One memory for all runs, or one each."""
    if len(initial) not in (0, 1, count):
        raise DataError(
            f"--initial: {len(initial)} states were given for {count} runs; give one for all, or one for each in "
            "their order."
        )
    return (initial[0] if initial else "unknown") if len(initial) < 2 else list(initial)
