"""The command `microid sensitivity`: its options, and the work."""

import dataclasses

import click

from fits.cli import _common as common
from fits.cli import _late as late
from fits.cli import _options as options
from fits.io._errors import DataError
from fits.io._file_set import file_set


@click.command()
@click.argument("stage", metavar="[STAGE.toml]", required=False)
@options.axis
@click.option(
    "--tolerance", metavar="LENGTH", help="Of all lengths instead of the stage's own, such as 0.02mm or 20um."
)
@click.option(
    "--level", type=click.IntRange(0, 1), help="0: slender leaves and rigid blocks; 1: the stage's default."
)
@click.option("--voltage", is_flag=True, help="Also at a fixed voltage, where a stiffer stage compresses its piezo.")
@options.json_output
@options.plots("plots")
@click.option("--write-stage", metavar="FILE", help="TOML file of the stage to write, to change and come back with.")
@common.in_sentences
def sensitivity(given: common.Given) -> None:
    """Rank what machining errors of the dimensions do to each motion of a stage.

    STAGE.toml holds the dimensions with their tolerances; without it, the stage is the paper's, and the tables are
    followed by what the paper reads in its Fig. 7. --write-stage writes one to begin with.
    """
    late.start_jax()
    common.refuse_clashes({"STAGE.toml": given.stage, "--write-stage": given.write_stage})
    design = _design(given.stage, given.tolerance, given.level)
    axes = tuple(name for name in late.AXES if given.axis in (name, "all"))
    with file_set() as files:
        drawings = files.folder(given.plots)
        unfinished_stage = None if given.write_stage is None else files.file(given.write_stage)
        report = late.sensitivities(design, axes)
        claimed = [] if given.stage or given.as_json else late.paper_claims(design)
        claims = [claim for claim in claimed if {*claim.axes} & {*axes}]
        drawn = [] if drawings is None else late.plot_sensitivity(design, report, drawings, form=given.form)
        if unfinished_stage is not None:
            unfinished_stage.write_text(late.design_text(design), encoding="utf-8")
    words = report.summary(given.voltage)
    if claims:
        words += f"\n\n{late.describe_claims(claims)}"
    plots = [("plot", place) for place in common.paths_in(given.plots, drawn)]
    places = [("stage", given.write_stage), *plots]
    common.print_result(given, late.sensitivity_json(report), common.with_places(words, places))


def _design(stage: str | None, tolerance: str | None, level: int | None) -> "late.Design":
    """The stage that is asked about."""
    design = late.paper_design() if stage in (None, "paper") else late.read_design(stage)
    if tolerance is not None:
        size_mm = common.length_mm("--tolerance", tolerance, ("mm", "um", "µm", "μm"), "0.02mm or 20um")
        try:
            design = design.with_tolerance(size_mm)
        except DataError as error:
            raise DataError(f"--tolerance {tolerance}: {error}") from None
    return design if level is None else dataclasses.replace(design, level=level)
