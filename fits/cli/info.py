"""The command `microid info`: its options, and the work."""

import click

from fits.cli import _common as common
from fits.cli import _late as late
from fits.cli import _options as options


@click.command()
@options.model
@options.json_output
@common.in_sentences
def info(given: common.Given) -> None:
    """Say what a model file holds."""
    held = late.read_model_text(given.model)
    kind, numbers = late.model_kind(given.model, held), list(late.model_numbers(held["model"]))
    content = {"written_by": held["written_by"], "model": kind, "parameters": numbers, "fit": held["fit"]}
    common.print_result(given, content, [] if given.as_json else [late.model_words(given.model, held)])
