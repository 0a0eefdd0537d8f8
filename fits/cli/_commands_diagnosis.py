"""The command that says what a model gets wrong: its options."""

from typing import Any

import click

from fits.cli._common import columns, in_sentences, json_output, limit, margin, quiet


@click.command()
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
@limit
@margin
@columns
@json_output
@quiet
@in_sentences
def diagnose(**options: Any) -> None:
    """Say what a fitted stage gets wrong, which physical effect causes it, and what to measure next.

    Writes report.html, diagnosis.json, the plain and the extended stage, and the voltages of the next experiment.
    Name the runs in the order in which they were taken. A column that begins with temp, and one of a second axis in
    um, nm, mm or m, are used. The end of every run is kept aside to check what is found.
    """
    from fits.cli._diagnose import run_diagnose

    run_diagnose(**options)
