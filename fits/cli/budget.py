"""The command `microid budget`: its options, and the work."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from fits.cli import _options as options
from fits.cli._common import Given, in_sentences, length_mm, paths_in, refuse_clashes, with_paths
from fits.io._errors import DataError
from fits.io._file_set import file_set

if TYPE_CHECKING:
    import microid as m

# What stands for the paper's stage instead of a file.
_PAPER = "paper"


@click.command()
@click.argument("stage", metavar="STAGE.toml|paper")
@options.model
@click.argument("idle", metavar="IDLE.csv")
@options.axis
@click.option(
    "--model-measures",
    type=click.Choice(["pzt", "x", "y", "z", "alpha", "beta", "gamma"]),
    default="pzt",
    show_default=True,
    help="What the displacement of MODEL.json is: the piezo's elongation, or the output of a motion.",
)
@click.option(
    "--arm", metavar="LENGTH", help="Where the sensor reads a rotation: its distance from the axis, as 50mm."
)
@click.option("--not-zeroed", "zeroed", flag_value=False, default=True, help="Count the offset of IDLE.csv too.")
@options.columns
@options.json_file("table")
@options.plots("a plot")
@in_sentences
def budget(given: Given) -> None:
    """Add up what driving, machining and measuring do to each motion of a stage.

    The driving error is the hysteresis of MODEL.json, from `microid fit`, over its whole range; the machining error
    is that of the tolerances in STAGE.toml, or of the paper's stage; the measuring error is what the sensor shows at
    rest in IDLE.csv, with the columns time_s and displacement_um.
    """
    import microid as m
    from fits.io._atomic import finite_json
    from fits.io._jax_setup import start_jax
    from fits.io._units import parse_columns
    from fits.machining._budget import budget
    from fits.machining._design import paper_design
    from fits.machining._design_file import read_design
    from fits.machining._idle import idle_noise, read_idle
    from fits.report._machining import budget_json, describe_budget

    start_jax()
    printed = given.json_file == "-"
    out = None if printed else given.json_file
    for what, path in {"STAGE.toml": given.stage, "MODEL.json": given.model, "IDLE.csv": given.idle}.items():
        refuse_clashes({what: None if path == _PAPER else path, "--json": out})
    arm_mm = None if given.arm is None else length_mm("--arm", given.arm, ("mm", "m"), "50mm")
    if arm_mm is None and given.model_measures in m.AXES and m.MOTIONS[given.model_measures].unit == "rad":
        raise DataError(
            f"--model-measures {given.model_measures}: expected the arm at which a displacement is a rotation, found "
            "none; add --arm, such as --arm 50mm."
        )
    with file_set() as files:
        # Entered before the work, so that a place that cannot be written to is refused before the wait.
        unfinished = None if out is None else files.file(out)
        drawings = files.folder(given.plots)
        design = paper_design() if given.stage == _PAPER else read_design(given.stage)
        noise = idle_noise(read_idle(given.idle, parse_columns(given.columns)))
        law = _law(given.model)
        axes = tuple(name for name in m.AXES if given.axis in (name, "all"))
        found = budget(design, law, noise, axes, measures=given.model_measures, arm_mm=arm_mm, zeroed=given.zeroed)
        text = finite_json(budget_json(found))
        drawn = []
        if drawings is not None:
            from fits.plots._machining import plot_budget

            drawn = plot_budget(found, drawings)
        if unfinished is not None:
            unfinished.write_text(f"{text}\n", encoding="utf-8")
    if printed:
        click.echo(text)
        return
    places = [("json", out), *(("plot", place) for place in paths_in(given.plots, drawn))]
    click.echo(with_paths(describe_budget(found), places))


def _law(path: str) -> m.Preisach:
    """The hysteresis of a model file, as slow voltages see it."""
    import microid as m
    from fits.cli._models import stage_or_preisach
    from fits.control._compensate_stage import static_equivalent
    from fits.stage._model_file import load_model

    model = stage_or_preisach(path, load_model(path))
    try:
        return static_equivalent(model) if isinstance(model, m.Stage) else model
    except DataError as error:
        raise DataError(f"{path}: {error}" if error.of_model else str(error)) from error
