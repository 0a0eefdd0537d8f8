"""The command `microid fit`: its options, and the work."""

from typing import Any

import click

from fits.cli import _common as common
from fits.cli import _late as late
from fits.cli import _options as options
from fits.io._errors import DataError
from fits.io._file_set import file_set

_HOLDS: dict[str, "late.Hold"] = {"lines": "first", "steps": "zero", "curves": "smooth"}


@click.command()
@options.runs
@click.option("--out", required=True, metavar="MODEL.json", help="Model file to write.")
@options.plots("plots and a page of them")
@click.option(
    "--model",
    type=click.Choice(["loop", "stage"]),
    default="loop",
    show_default=True,
    help="Hysteresis alone, from slow runs; or the whole stage with driver and mechanics, from slow and fast ones.",
)
@click.option(
    "--start",
    metavar="START.json",
    help="Model file of the stage to fit in place of the default one, such as one with a hysteresis inside its "
    "mechanics; without a Preisach operator on a grid it starts from its present values. Implies --model stage.",
)
@click.option("--family", metavar="NAME", help="Density: grid, mixture or network (default grid).")
@click.option("--levels", type=int, help="Number of switching voltages; found from the data by default.")
@click.option("--lag", is_flag=True, help="Fit a lag of the readings beside a hysteresis alone.")
@click.option(
    "--relaxation",
    "relaxations",
    type=click.IntRange(0, 6),
    default=0,
    metavar="N",
    help="Fit so many relaxations beside a hysteresis alone, for creep.",
)
@options.holdout(
    "Fraction at the end of every run that is only predicted (default 0.2), or a file that is; again for more files."
)
@options.columns
@options.initial(
    "all runs (default unknown); for a stage, give it again for each further run", default=None, multiple=True
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
@click.option("--seed", type=options.SEEDS, help="Seed of the starts (default 0).")
@options.json_output
@common.in_sentences
def fit(given: common.Given) -> None:
    """Fit Preisach weights to measured loops, or a whole stage to slow and fast runs.

    The files are runs of one rig, with the columns time_s, voltage_V and displacement_um. A stage needs a slow run
    over the whole range, and one with steps, a chirp or a multisine beyond the resonance.
    """
    given.model = "stage" if given.start else given.model
    slow = given.model == "loop" and bool(given.lag or given.relaxations)
    asked = _for_stage(given) if given.model == "stage" else _for_slow(given) if slow else _for_loop(given)
    initial = list(given.initial) if len(given.initial) > 1 else (given.initial or ("unknown",))[0]
    progress = common.progress_to_stderr(given.quiet)
    how = common.reading(given)
    fraction, files = common.fraction_or_files(given.holdout)
    common.refuse_overwriting(given.out, [*given.runs, *files, *filter(None, [given.start])])
    with file_set() as made:
        unfinished, drawings = made.file(given.out), made.folder(given.plots)
        records = late.read_runs(given.runs, **how)
        same = {"holdout": [late.read_table(file, **how) for file in files] or fraction, "initial": initial}
        if given.start:
            late.read_model_text(given.start)
        # Only now, so that what cannot be read is refused at once.
        late.start_jax()
        estimate: Any = late.fit_slow if slow else late.fit
        if given.model == "stage":
            estimate = late.fit_stage
            asked["stage"] = _start(given)
        asked |= {"levels": given.levels, "loss": given.loss or "squares", "progress": progress}
        result = estimate(records, **same, **asked)
        report, drawn = late.fit_report(result), []
        words = late.describe(report)
        if drawings is not None:
            progress("drawing")
            draw: Any = late.plot_stage if slow or given.model == "stage" else late.plot_fit
            drawn = draw(result, records, drawings, **same, form=given.form)
            late.write_page(drawings, f"Fit of {', '.join(one.source for one in records)}", words, drawn)
        unfinished.write_text(late.model_text(result.model, result.uncertainty, report), encoding="utf-8")
    places = common.paths_in(given.plots, drawn)
    lines = [words, "", f"model  {given.out}", *(f"plot   {place}" for place in places), *common.page(given)]
    common.print_result(given, {"out": given.out, "plots": places, **report}, lines)


def _start(given: common.Given) -> "late.Stage | None":
    """The stage to fit: that of a model file, or the default one; None for that of the fit itself."""
    if given.start is None:
        return late.default_stage(_HOLDS[given.hold]) if given.hold else None
    stage = late.load_model(given.start).model
    if not isinstance(stage, late.Stage):
        raise DataError(
            f"{given.start}: expected a stage to start from, found a {type(stage).__name__}; name the model file of "
            "a stage."
        )
    return stage.with_hold(_HOLDS[given.hold]) if given.hold else stage


def _for_loop(given: common.Given) -> dict[str, Any]:
    """What `fit` is asked for, beside what `fit_stage` is too; what it cannot honour is refused."""
    if given.hold is not None:
        raise DataError(
            f"--hold {given.hold}: only the fit of a stage has a choice; leave it out, or use --model stage."
        )
    if len(given.initial) > 1:
        raise DataError(
            f"--initial: expected one state for all runs, found {len(given.initial)}; give one, or use --model stage."
        )
    return {"family": given.family or "grid", "starts": given.starts or 8, "seed": given.seed or 0}


def _for_slow(given: common.Given) -> dict[str, Any]:
    """What `fit_slow` is asked for, beside what `fit` is too; what it cannot honour is refused."""
    _for_loop(given)
    _refuse_random(given, "beside a lag or relaxations")
    return {"lag": given.lag, "relaxations": given.relaxations}


def _refuse_random(given: common.Given, where: str) -> None:
    """Refuse densities other than a grid, and starts at random."""
    if given.family not in (None, "grid"):
        raise DataError(f"--family {given.family}: the hysteresis {where} is fitted on a grid; leave out --family.")
    for name, value in (("starts", given.starts), ("seed", given.seed)):
        if value is not None:
            raise DataError(f"--{name} {value}: a fit {where} does not start at random; leave out --{name}.")


def _for_stage(given: common.Given) -> dict[str, Any]:
    """No further settings; what the fit of a stage cannot honour is refused."""
    if given.lag or given.relaxations:
        raise DataError("--lag, --relaxation: a stage has a driver and mechanics that lag; leave them out.")
    _refuse_random(given, "of a stage")
    if len(given.initial) not in (0, 1, len(given.runs)):
        raise DataError(
            f"--initial: {len(given.initial)} states were given for {len(given.runs)} runs; give one for all, or one "
            "for each in their order."
        )
    return {}
