"""The command `microid export`: its options, and the work."""

from typing import Any

import click

from fits.cli import _common as common
from fits.cli import _late as late
from fits.cli import _options as options


@click.command()
@options.model
@options.out_folder
@click.option("--name", default="compensator", show_default=True, help="Name of the files, before all names in them.")
@click.option("--memory", type=int, default=128, show_default=True, help="Extremes remembered, two per nested loop.")
@options.limits
@options.json_output
@common.in_sentences
def export(given: common.Given) -> None:
    """Write a model and its inverse as C99 for a controller.

    The header and the source need no library and allocate nothing.
    """
    loaded, limits_V = common.opened(given.model), common.parse_limits_V(given.limits)
    if isinstance(loaded, late.PlainModel):
        model: Any = loaded
        law: Any = loaded.static
    else:
        model = common.stage_or_preisach(given.model, loaded)
        law = late.static_equivalent(model)
    remarks = list[str]()
    if law is not model:
        # The inverse of mechanics needs the samples to come, which a controller does not have.
        remarks = ["the files hold the hysteresis with the static gains of the stage; what moves in it is left out."]
    made = late.export_c(law, given.out, given.name, size=given.memory, limits_V=limits_V)
    files = [str(file) for file in made]
    lines = [*(f"Note: {remark}" for remark in remarks), *files]
    common.print_result(given, {"files": files, "remarks": remarks}, lines)
