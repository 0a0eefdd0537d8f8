"""The commands that close a loop around a model: their options."""

from typing import Any

import click

from fits.cli._common import columns, in_sentences, json_output, limit, limits, margin, quiet


@click.command()
@click.argument("model", metavar="MODEL.json")
@click.argument("reference", metavar="REFERENCE.csv")
@click.option("--out", required=True, metavar="RUN.csv", help="CSV to write; .gz is compressed.")
@click.option("--plots", metavar="DIR", help="Folder for plots; it is made if need be.")
@click.option(
    "--controller",
    type=click.Choice(["pid", "bp-pid", "cmac-pid", "resonant"]),
    default="pid",
    show_default=True,
    help="Which controller; the last three are made around a PID controller.",
)
@click.option(
    "--gains",
    metavar="KP,KI,KD|FILE",
    help="Gains in V/um, V/(um s) and V s/um, or what --json printed; tuned by default. Limits stated beside them "
    "are checked, default ones remarked on.",
)
@click.option(
    "--feedforward",
    type=click.Choice(["none", "static", "dynamic"]),
    default="static",
    show_default=True,
    help="What is added to the feedback: nothing, the inverse of the hysteresis, or of the whole stage.",
)
@click.option(
    "--frequency", type=float, multiple=True, metavar="HZ", help="Of a resonator; the reference's own by default."
)
@click.option("--noise", type=float, default=0.0, metavar="UM", help="Standard deviation of sensor noise, in um.")
@click.option("--delay", type=click.IntRange(0, 100), default=0, metavar="SAMPLES", help="Age of a reading.")
@click.option("--resolution", type=float, metavar="UM", help="Steps of the sensor, in um.")
@click.option("--resolution-voltage", type=float, metavar="V", help="Steps of the amplifier's command, in V.")
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
@click.option(
    "--plants",
    type=click.IntRange(1, 100),
    help="Models drawn from the uncertainty of the fit, all to be controlled (default 4, or 1 without one).",
)
@click.option("--overshoot", type=float, metavar="PCT", help="Largest overshoot, in percent of the range.")
@click.option("--gain-margin", type=float, help="Least gain margin (default 2).")
@click.option("--phase-margin", type=float, help="Least phase margin, in degrees (default 30).")
@click.option("--peak", type=float, help="Largest peak of the sensitivity (default 2).")
@click.option("--effort", type=float, default=0.0, metavar="UM/V", help="Weight of the feedback in the cost.")
@click.option("--rate", type=float, default=0.0, metavar="UM/V", help="Weight of the command's steps in the cost.")
@click.option("--skip", type=float, default=0.0, metavar="S", help="Time at the beginning that does not count, in s.")
@click.option("--starts", type=click.IntRange(1, 100), default=2, show_default=True, help="Places to tune from.")
@click.option("--seed", type=click.IntRange(0, 2**32 - 1), default=0, help="Of noise, plants and starts (default 0).")
@columns
@json_output
@quiet
@in_sentences
def control(**options: Any) -> None:
    """Tune a controller on a model, and run it along a reference.

    REFERENCE.csv needs the columns time_s, in even steps, and displacement_um: what the sensor is to read, its offset
    included. The run has time_s, reference_um, displacement_um, measured_um, command_V and error_um. The least error
    is sought within all limits, for every plant; a loop that is unstable or beyond a limit is refused. What --json
    prints makes the same controller again with --gains, for the same model, reference and seed.
    """
    from fits.cli._control import run_control

    run_control(**options)
