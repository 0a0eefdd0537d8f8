"""The command that repeats the paper's tables: its options."""

from typing import Any

import click

from fits.cli._common import in_sentences, quiet


@click.command()
@click.option("--out", required=True, metavar="DIR", help="Folder to write to; it is made if need be.")
@click.option(
    "--seeds", type=click.IntRange(1, 100), default=10, show_default=True, help="How many noises to go through."
)
@click.option(
    "--seed", type=click.IntRange(0, 2**32 - 1), default=0, show_default=True, help="Where all randomness starts."
)
@quiet
@in_sentences
def paper(**options: Any) -> None:
    """Repeat the paper's compensation on a virtual stage: its tables and figures beside ours.

    Writes paper.md with pictures, and paper.json. The stage is identified from noisy CSVs, then run open, under
    feedforward, and with each of the paper's three controllers.
    """
    from fits.cli._paper import run_paper

    run_paper(**options)
