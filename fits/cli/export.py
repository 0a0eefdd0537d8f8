"""The command `microid export`: its options, and the work."""

from typing import Any

import click

from fits.cli import _common as common
from fits.cli import _late as late
from fits.cli import _options as options
from fits.io._errors import DataError


@click.command()
@options.model
@options.out_folder
@click.option("--name", default="compensator", show_default=True, help="Name of the files, before all names in them.")
@click.option(
    "--rate",
    type=float,
    metavar="HZ",
    help="Samples a second of the simulation that is written of a stage with a hysteresis inside its mechanics.",
)
@click.option("--memory", type=int, default=128, show_default=True, help="Extremes remembered, two per nested loop.")
@options.limits
@options.json_output
@common.in_sentences
def export(given: common.Given) -> None:
    """Write a model and its inverse as C99 for a controller.

    The header and the source need no library and allocate nothing. Of a stage with a hysteresis inside its mechanics
    they hold the simulation at one sample rate, and need <math.h>.
    """
    loaded, limits_V = common.opened(given.model), common.parse_limits_V(given.limits)
    model: Any = loaded
    if not isinstance(loaded, late.PlainModel):
        model = common.stage_or_preisach(given.model, loaded)
    remarks = list[str]()
    if model is not loaded and isinstance(model, late.Stage) and late.yields_inside(model):
        if not given.rate or limits_V:
            raise DataError(
                f"{given.model}: what is written of a stage with a hysteresis inside its mechanics is its "
                "simulation; give the --rate of the command, and no --limits."
            )
        if model.hold == "smooth":
            # Curves need the samples to come, which a controller does not have.
            remarks = ["the command runs in lines between samples, not in curves; a higher rate makes them alike."]
        made = late.export_simulation_c(model, given.out, given.name, 1 / given.rate, size=given.memory)
    else:
        if given.rate:
            raise DataError("--rate: the files hold a hysteresis, which knows no rate; leave it out.")
        law: Any = loaded.static if isinstance(loaded, late.PlainModel) else late.static_equivalent(model)
        if law is not model:
            # The inverse of mechanics needs the samples to come, too.
            remarks = [
                "the files hold the hysteresis with the static gains of the stage; what moves in it is left out."
            ]
        made = late.export_c(law, given.out, given.name, size=given.memory, limits_V=limits_V)
    files = [str(file) for file in made]
    lines = [*(f"Note: {remark}" for remark in remarks), *files]
    common.print_result(given, {"files": files, "remarks": remarks}, lines)
