"""The `microid` command: what can be asked of it.

Only the standard library and click are imported here; the work, and what it imports, is in other modules named
`_cli_...`.
"""

import functools
import sys
from collections.abc import Callable
from typing import Any, TypeVar

import click

from fits._errors import DataError

_Command = TypeVar("_Command", bound=Callable[..., None])


def _in_sentences(command: _Command) -> _Command:
    """Turn bad input and interruption into one line on stderr and an exit status."""

    @functools.wraps(command)
    def run(*args: Any, **kwargs: Any) -> None:
        try:
            command(*args, **kwargs)
        except KeyboardInterrupt:
            click.echo("Interrupted: no unfinished file was left.", err=True)
            sys.exit(130)
        except DataError as error:
            sentence = " ".join(str(error).split())
            click.echo(sentence if sentence.endswith(".") else f"{sentence}.", err=True)
            sys.exit(2)

    return run  # type: ignore[return-value]


def _show_version(context: click.Context, _: click.Parameter, wanted: bool) -> None:
    if wanted and not context.resilient_parsing:
        from fits._version import written_by

        click.echo(written_by())
        context.exit()


def _list_scenarios(context: click.Context, _: click.Parameter, wanted: bool) -> None:
    if wanted and not context.resilient_parsing:
        from fits._cli_synth import scenario_lines

        click.echo("\n".join(scenario_lines()))
        context.exit()


_columns = click.option(
    "--columns",
    metavar="NAME=SOURCE,...",
    default="",
    help="Which columns to read, such as voltage_V=u1_V,displacement_um=-height[nm].",
)
_limits = click.option("--limits", metavar="LOW,HIGH", help="Voltages allowed, in V; the model's range by default.")
_json = click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")
_quiet = click.option("--quiet", is_flag=True, help="No progress on stderr.")


@click.group(context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100})
@click.option(
    "--version",
    is_flag=True,
    expose_value=False,
    is_eager=True,
    callback=_show_version,
    help="Show the version and exit.",
)
def cli() -> None:
    """Identify a piezo-driven micro-positioner from CSV files of voltage and displacement.

    Bad input ends with status 2 and one sentence on stderr. Compiled functions are kept in the user's cache folder;
    MICROID_CACHE names another, and MICROID_CACHE=off keeps none.
    """


@cli.command()
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
@_columns
@click.option(
    "--initial",
    type=click.Choice(["unknown", "negative", "positive", "demagnetised"]),
    multiple=True,
    help="Memory before all runs (default unknown); for a stage, give it again for each further run.",
)
@click.option(
    "--loss",
    type=click.Choice(["squares", "huber"]),
    help="What the fit of a stage minimises (default squares); outliers count less in huber.",
)
@click.option(
    "--hold",
    type=click.Choice(["lines", "steps"]),
    help="How the command of a stage runs between samples (default lines); a converter that holds it makes steps.",
)
@click.option("--starts", type=click.IntRange(min=1), help="Starts for families whose fit is not convex (default 8).")
@click.option("--seed", type=click.IntRange(min=0), help="Seed of the starts (default 0).")
@_json
@_quiet
@_in_sentences
def fit(**options: Any) -> None:
    """Fit Preisach weights to measured loops, or a whole stage to slow and fast runs.

    The files are runs of one rig, with the columns time_s, voltage_V and displacement_um. A stage needs a slow run
    over the whole range, and one with steps, a chirp or a multisine beyond the resonance.
    """
    from fits._cli_fit import run_fit

    run_fit(**options)


@cli.command()
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
@_columns
@_json
@_in_sentences
def simulate(**options: Any) -> None:
    """Predict the displacement of a voltage program, with its standard deviation.

    PROGRAM.csv needs the columns time_s and voltage_V. The prediction has time_s, voltage_V, displacement_um and
    displacement_sd_um; sensor noise is not in the last.
    """
    from fits._cli_work import run_simulate

    run_simulate(**options)


@cli.command()
@click.argument("model", metavar="MODEL.json")
@click.argument("reference", metavar="REFERENCE.csv")
@click.option("--out", required=True, metavar="VOLTAGE.csv", help="CSV to write; .gz is compressed.")
@click.option(
    "--static", "way", flag_value="static", default="static", help="Compensate the hysteresis only: the default."
)
@click.option("--dynamic", "way", flag_value="dynamic", help="Compensate the mechanics and the driver too.")
@click.option("--clip", is_flag=True, help="Where the reference is out of reach take the nearest that is not.")
@_limits
@click.option(
    "--initial",
    type=click.Choice(["negative", "positive", "demagnetised"]),
    default="negative",
    show_default=True,
    help="Memory before the reference.",
)
@click.option("--plots", metavar="DIR", help="Folder for a plot; it is made if need be.")
@_columns
@_json
@_in_sentences
def compensate(**options: Any) -> None:
    """Find the voltage that makes the stage follow a reference.

    REFERENCE.csv needs the columns time_s and displacement_um: what the sensor is to read, its offset included. The
    result has time_s, voltage_V and displacement_um, which is what the model then does.
    """
    from fits._cli_compensate import run_compensate

    run_compensate(**options)


@cli.command()
@click.argument("model", metavar="MODEL.json")
@click.option("--out", required=True, metavar="DIR", help="Folder to write to; it is made if need be.")
@click.option("--name", default="compensator", show_default=True, help="Name of the files, before all names in them.")
@click.option("--memory", type=int, default=128, show_default=True, help="Extremes remembered, two per nested loop.")
@_limits
@_json
@_in_sentences
def export(**options: Any) -> None:
    """Write a model and its inverse as C99 for a controller.

    The header and the source need no library and allocate nothing.
    """
    from fits._cli_compensate import run_export

    run_export(**options)


@cli.command()
@click.argument("scenario")
@click.option("--out", required=True, metavar="DIR", help="Folder to write to; it is made if need be.")
@click.option("--seed", type=click.IntRange(min=0), help="Seed; the scenario's own by default.")
@click.option(
    "--list",
    is_flag=True,
    expose_value=False,
    is_eager=True,
    callback=_list_scenarios,
    help="List the scenarios and exit.",
)
@_json
@_in_sentences
def synth(**options: Any) -> None:
    """Write example CSVs from a virtual test bench.

    SCENARIO is one of those that --list shows, or a .toml file.
    """
    from fits._cli_synth import run_synth

    run_synth(**options)


@cli.command()
@click.argument("model", metavar="MODEL.json")
@_json
@_in_sentences
def info(**options: Any) -> None:
    """Say what a model file holds."""
    from fits._cli_work import run_info

    run_info(**options)


@cli.command()
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
@_in_sentences
def sensitivity(**options: Any) -> None:
    """Rank what machining errors of the dimensions do to each motion of a stage.

    STAGE.toml holds the dimensions with their tolerances; without it, the stage is the paper's, and the tables are
    followed by what the paper reads in its Fig. 7. --write-stage writes one to begin with.
    """
    from fits._cli_sensitivity import run_sensitivity

    run_sensitivity(**options)


@cli.command()
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
@_columns
@click.option("--json", "json_file", metavar="FILE", help="JSON file to write; - prints it instead of the table.")
@click.option("--plots", metavar="DIR", help="Folder for a plot; it is made if need be.")
@_in_sentences
def budget(**options: Any) -> None:
    """Add up what driving, machining and measuring do to each motion of a stage.

    The driving error is the hysteresis of MODEL.json, from `microid fit`, over its whole range; the machining error
    is that of the tolerances in STAGE.toml, or of the paper's stage; the measuring error is what the sensor shows at
    rest in IDLE.csv, with the columns time_s and displacement_um.
    """
    from fits._cli_budget import run_budget

    run_budget(**options)


@cli.command()
@click.argument("runs", metavar="RUN.csv [MORE.csv ...]", nargs=-1, required=True)
@click.option("--out", required=True, metavar="DIR", help="Folder to write to; it is made if need be.")
@click.option(
    "--holdout", multiple=True, metavar="FRACTION|FILE", help="What is only predicted, as for fit (default 0.2)."
)
@click.option(
    "--false-alarm", type=float, default=0.01, show_default=True, help="Chance of a cause where there is none."
)
@click.option("--duration", type=float, metavar="SECONDS", help="Of the next experiment, at most.")
@click.option(
    "--initial",
    type=click.Choice(["unknown", "negative", "positive", "demagnetised"]),
    default="unknown",
    show_default=True,
    help="Memory before all runs.",
)
@_columns
@_json
@_quiet
@_in_sentences
def diagnose(**options: Any) -> None:
    """Say what a fitted stage gets wrong, which physical effect causes it, and what to measure next.

    Writes report.html, diagnosis.json, the plain and the extended stage, and the voltages of the next experiment.
    Name the runs in the order in which they were taken. A column that begins with temp, and one of a second axis in
    um, nm, mm or m, are used. The end of every run is kept aside to check what is found.
    """
    from fits._cli_diagnose import run_diagnose

    run_diagnose(**options)


def main() -> None:
    """Run the command."""
    cli(prog_name="microid")
