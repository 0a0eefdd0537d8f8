"""The commands that make models of records and use them: their options."""

from typing import Any

import click

from fits.cli._common import columns, in_sentences, json_output, limit, limits, margin, quiet


def _list_scenarios(context: click.Context, _: click.Parameter, wanted: bool) -> None:
    if wanted and not context.resilient_parsing:
        from fits.cli._synth import scenario_lines

        click.echo("\n".join(scenario_lines()))
        context.exit()


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
def fit(**options: Any) -> None:
    """Fit Preisach weights to measured loops, or a whole stage to slow and fast runs.

    The files are runs of one rig, with the columns time_s, voltage_V and displacement_um. A stage needs a slow run
    over the whole range, and one with steps, a chirp or a multisine beyond the resonance.
    """
    from fits.cli._fit import run_fit

    run_fit(**options)


@click.command()
@click.argument("model", metavar="MODEL.json")
@click.argument("program", metavar="PROGRAM.csv")
@click.option("--out", required=True, metavar="PREDICTION.csv", help="CSV to write; .gz is compressed.")
@click.option(
    "--initial",
    type=click.Choice(["negative", "positive", "demagnetised"]),
    default="negative",
    show_default=True,
    help="Memory before the program.",
)
@columns
@json_output
@in_sentences
def simulate(**options: Any) -> None:
    """Predict the displacement of a voltage program, with its standard deviation.

    PROGRAM.csv needs the columns time_s and voltage_V. The prediction has time_s, voltage_V, displacement_um and
    displacement_sd_um; sensor noise is not in the last.
    """
    from fits.cli._work import run_simulate

    run_simulate(**options)


@click.command()
@click.argument("model", metavar="MODEL.json")
@click.argument("reference", metavar="REFERENCE.csv")
@click.option("--out", required=True, metavar="VOLTAGE.csv", help="CSV to write; .gz is compressed.")
@click.option(
    "--static", "way", flag_value="static", default="static", help="Compensate the hysteresis only: the default."
)
@click.option("--dynamic", "way", flag_value="dynamic", help="Compensate the mechanics and the driver too.")
@click.option("--clip", is_flag=True, help="Where the reference is out of reach take the nearest that is not.")
@limits
@limit
@margin
@click.option(
    "--initial",
    type=click.Choice(["negative", "positive", "demagnetised"]),
    default="negative",
    show_default=True,
    help="Memory before the reference.",
)
@click.option("--plots", metavar="DIR", help="Folder for a plot; it is made if need be.")
@columns
@json_output
@in_sentences
def compensate(**options: Any) -> None:
    """Find the voltage that makes the stage follow a reference.

    REFERENCE.csv needs the columns time_s and displacement_um: what the sensor is to read, its offset included. The
    result has time_s, voltage_V and displacement_um, which is what the model then does.
    """
    from fits.cli._compensate import run_compensate

    run_compensate(**options)


@click.command()
@click.argument("model", metavar="MODEL.json")
@click.option("--out", required=True, metavar="DIR", help="Folder to write to; it is made if need be.")
@click.option("--name", default="compensator", show_default=True, help="Name of the files, before all names in them.")
@click.option("--memory", type=int, default=128, show_default=True, help="Extremes remembered, two per nested loop.")
@limits
@json_output
@in_sentences
def export(**options: Any) -> None:
    """Write a model and its inverse as C99 for a controller.

    The header and the source need no library and allocate nothing.
    """
    from fits.cli._compensate import run_export

    run_export(**options)


@click.command()
@click.argument("scenario")
@click.option("--out", required=True, metavar="DIR", help="Folder to write to; it is made if need be.")
@click.option("--seed", type=click.IntRange(0, 2**64 - 1), help="Seed; the scenario's own by default.")
@click.option(
    "--list",
    is_flag=True,
    expose_value=False,
    is_eager=True,
    callback=_list_scenarios,
    help="List the scenarios and exit.",
)
@json_output
@in_sentences
def synth(**options: Any) -> None:
    """Write example CSVs from a virtual test bench.

    SCENARIO is one of those that --list shows, or a .toml file.
    """
    from fits.cli._synth import run_synth

    run_synth(**options)


@click.command()
@click.argument("model", metavar="MODEL.json")
@json_output
@in_sentences
def info(**options: Any) -> None:
    """Say what a model file holds."""
    from fits.cli._work import run_info

    run_info(**options)
