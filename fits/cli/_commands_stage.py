"""The commands about the dimensions of a stage: their options."""

from typing import Any

import click

from fits.cli._common import columns, in_sentences


@click.command()
@click.argument("stage", metavar="[STAGE.toml]", required=False)
@click.option(
    "--axis",
    type=click.Choice(["x", "y", "z", "alpha", "beta", "gamma", "all"]),
    default="all",
    show_default=True,
    help="Which motion.",
)
@click.option(
    "--tolerance", metavar="LENGTH", help="Of all lengths instead of the stage's own, such as 0.02mm or 20um."
)
@click.option(
    "--level", type=click.IntRange(0, 1), help="0: slender leaves and rigid blocks; 1: the stage's default."
)
@click.option("--voltage", is_flag=True, help="Also at a fixed voltage, where a stiffer stage compresses its piezo.")
@click.option("--json", "json_file", metavar="FILE", help="JSON file to write; - prints it instead of the tables.")
@click.option("--plots", metavar="DIR", help="Folder for plots; it is made if need be.")
@click.option("--write-stage", metavar="FILE", help="TOML file of the stage to write, to change and come back with.")
@in_sentences
def sensitivity(**options: Any) -> None:
    """Rank what machining errors of the dimensions do to each motion of a stage.

    STAGE.toml holds the dimensions with their tolerances; without it, the stage is the paper's, and the tables are
    followed by what the paper reads in its Fig. 7. --write-stage writes one to begin with.
    """
    from fits.cli._sensitivity import run_sensitivity

    run_sensitivity(**options)


@click.command()
@click.argument("stage", metavar="STAGE.toml|paper")
@click.argument("model", metavar="MODEL.json")
@click.argument("idle", metavar="IDLE.csv")
@click.option(
    "--axis",
    type=click.Choice(["x", "y", "z", "alpha", "beta", "gamma", "all"]),
    default="all",
    show_default=True,
    help="Which motion.",
)
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
@columns
@click.option("--json", "json_file", metavar="FILE", help="JSON file to write; - prints it instead of the table.")
@click.option("--plots", metavar="DIR", help="Folder for a plot; it is made if need be.")
@in_sentences
def budget(**options: Any) -> None:
    """Add up what driving, machining and measuring do to each motion of a stage.

    The driving error is the hysteresis of MODEL.json, from `microid fit`, over its whole range; the machining error
    is that of the tolerances in STAGE.toml, or of the paper's stage; the measuring error is what the sensor shows at
    rest in IDLE.csv, with the columns time_s and displacement_um.
    """
    from fits.cli._budget import run_budget

    run_budget(**options)
