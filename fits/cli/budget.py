"""The command `microid budget`: its options, and the work."""

import click

from fits.cli import _common as common
from fits.cli import _late as late
from fits.cli import _options as options
from fits.io._errors import DataError
from fits.io._file_set import file_set


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
@options.plots("a plot")
@options.json_output
@common.in_sentences
def budget(given: common.Given) -> None:
    """Add up what driving, machining and measuring do to each motion of a stage.

    The driving error is the hysteresis of MODEL.json, from `microid fit`, over its whole range; the machining error
    is that of the tolerances in STAGE.toml, or of the paper's stage; the measuring error is what the sensor shows at
    rest in IDLE.csv, with the columns time_s and displacement_um.
    """
    # What is no model is refused at once.
    late.read_model_text(given.model)
    late.start_jax()
    arm_mm = None if given.arm is None else common.length_mm("--arm", given.arm, ("mm", "m"), "50mm")
    if arm_mm is None and given.model_measures in late.AXES and late.MOTIONS[given.model_measures].unit == "rad":
        raise DataError(
            f"--model-measures {given.model_measures}: expected the arm at which a displacement is a rotation, found "
            "none; add --arm, such as --arm 50mm."
        )
    with file_set() as files:
        drawings = files.folder(given.plots)
        design = late.paper_design() if given.stage == "paper" else late.read_design(given.stage)
        noise = late.idle_noise(late.read_idle(given.idle, **common.reading(given)))
        axes = tuple(name for name in late.AXES if given.axis in (name, "all"))
        how = {"measures": given.model_measures, "arm_mm": arm_mm, "zeroed": given.zeroed}
        found = late.budget(design, _law(given.model), noise, axes, **how)
        drawn = [] if drawings is None else late.plot_budget(found, drawings, form=given.form)
    places = [("plot", place) for place in common.paths_in(given.plots, drawn)]
    common.print_result(given, late.budget_json(found), common.with_places(found.summary(), places))


def _law(path: str) -> "late.Preisach":
    """The hysteresis of a model file, as slow voltages see it."""
    return late.static_equivalent(common.stage_or_preisach(path, late.load_model(path)))
