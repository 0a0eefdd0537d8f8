"""The command `microid fit`: its options, and the work."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from microid import Hold
from fits.cli._common import Given, columns, in_sentences, json_output, quiet
from fits.cli._files import fraction_or_files, keep_inputs, progress_to_stderr
from fits.io._errors import DataError
from fits.io._file_set import file_set

_HOLDS: dict[str, Hold] = {"lines": "first", "steps": "zero", "curves": "smooth"}


@click.command()
@click.argument("runs", metavar="RUN.csv [MORE.csv ...]", nargs=-1, required=True)
@click.option("--out", required=True, metavar="MODEL.json", help="Model file to write.")
@click.option("--plots", metavar="DIR", help="Folder for plots; it is made if need be.")
@click.option(
    "--model",
    type=click.Choice(["loop", "stage"]),
    default="loop",
    show_default=True,
    help="Hysteresis alone, from slow runs; or the whole stage with driver and mechanics, from slow and fast ones.",
)
@click.option("--family", metavar="NAME", help="Density: grid, mixture or network (default grid).")
@click.option("--levels", type=int, help="Number of switching voltages; found from the data by default.")
@click.option(
    "--holdout",
    multiple=True,
    metavar="FRACTION|FILE",
    help="Fraction at the end of every run that is only predicted (default 0.2), or a CSV that is; give it again for "
    "more files.",
)
@columns
@click.option(
    "--initial",
    type=click.Choice(["unknown", "negative", "positive", "demagnetised"]),
    multiple=True,
    help="Memory before all runs (default unknown); for a stage, give it again for each further run.",
)
@click.option(
    "--loss",
    type=click.Choice(["squares", "huber"]),
    help="What the fit minimises (default squares); outliers count less in huber.",
)
@click.option(
    "--hold",
    type=click.Choice(["lines", "steps", "curves"]),
    help="How the command of a stage runs between samples (default lines); a converter that holds it makes steps, a "
    "smooth one curves.",
)
@click.option(
    "--starts", type=click.IntRange(1, 100), help="Starts for families whose fit is not convex (default 8)."
)
@click.option("--seed", type=click.IntRange(0, 2**32 - 1), help="Seed of the starts (default 0).")
@json_output
@quiet
@in_sentences
def fit(given: Given) -> None:
    """Fit Preisach weights to measured loops, or a whole stage to slow and fast runs.

    The files are runs of one rig, with the columns time_s, voltage_V and displacement_um. A stage needs a slow run
    over the whole range, and one with steps, a chirp or a multisine beyond the resonance.
    """
    from fits.io._atomic import finite_json
    from fits.io._jax_setup import start_jax
    from fits.io._read_csv import read_csv, read_runs
    from fits.io._units import parse_columns
    from fits.loop._fit import fit
    from fits.loop._result import FitError
    from fits.plots._loop import plot_fit
    from fits.plots._stage import plot_stage
    from fits.report._fit import describe, fit_report
    from fits.stage._fit import fit_stage
    from fits.stage._model_file import model_text

    start_jax()
    states: str | list[str]
    options: dict[str, Any]
    if given.model == "stage":
        kind = _Kind(fit_stage, plot_stage)
        states, options = _stage_options(
            given.family, given.starts, given.seed, given.loss, given.hold, given.initial, len(given.runs)
        )
    else:
        kind = _Kind(fit, plot_fit)
        states, options = _loop_options(given.family, given.starts, given.seed, given.loss, given.hold, given.initial)
    progress = progress_to_stderr(given.quiet)
    mapping = parse_columns(given.columns)
    fraction, files = fraction_or_files(given.holdout)
    keep_inputs(given.out, [*given.runs, *files])
    # Entered before the fit, so that a place that cannot be written to is refused before the wait.
    with file_set() as made:
        unfinished, drawings = made.file(given.out), made.folder(given.plots)
        records = read_runs(given.runs, mapping)
        aside = [read_csv(file, mapping) for file in files]
        left_out = aside or fraction
        try:
            result = kind.fit(
                records, levels=given.levels, holdout=left_out, initial=states, progress=progress, **options
            )
        except FitError as error:
            raise DataError(f"{error}.") from error
        report = fit_report(result)
        drawn: Sequence[Path] = ()
        if drawings is not None:
            progress("drawing")
            drawn = kind.plot(result, records, drawings, holdout=left_out, initial=states)
        unfinished.write_text(model_text(result.model, result.uncertainty, report), encoding="utf-8")
    places = [str(Path(given.plots) / path.name) for path in drawn] if given.plots else []
    if given.as_json:
        click.echo(finite_json({"out": given.out, "plots": places, **report}))
    else:
        click.echo("\n".join([describe(report), "", f"model  {given.out}", *(f"plot   {place}" for place in places)]))


@dataclass(frozen=True)
class _Kind:
    """What can be fitted: how, and how to draw it."""

    fit: Callable[..., Any]
    plot: Callable[..., Sequence[Path]]


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
    from fits.stage._fit import default_stage

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
