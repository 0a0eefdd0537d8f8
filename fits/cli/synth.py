"""The command `microid synth`: its options, and the work."""

from __future__ import annotations

import json
from pathlib import Path

import click

from fits.cli._common import Given, in_sentences, json_output
from fits.io._errors import DataError
from fits.io._file_set import file_set


def _list_scenarios(context: click.Context, _: click.Parameter, wanted: bool) -> None:
    if wanted and not context.resilient_parsing:
        import data_synth

        for name in data_synth.scenario_names():
            click.echo(f"{name:20} {data_synth.load_scenario(name).description}")
        context.exit()


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
def synth(given: Given) -> None:
    """Write example CSVs from a virtual test bench.

    SCENARIO is one of those that --list shows, or a .toml file.
    """
    import data_synth

    with file_set() as made:
        # Before the work, so that a place that cannot be written to is refused before the wait.
        folder = made.folder(given.out, "--out")
        try:
            bench = data_synth.simulate(data_synth.load_scenario(given.scenario), given.seed)
        except data_synth.ScenarioError as error:
            raise DataError(str(error)) from error
        contents = data_synth.files(bench)
        for name, text in contents.items():
            (folder / name).write_bytes(text.encode())
    files = [str(Path(given.out) / name) for name in contents]
    if given.as_json:
        click.echo(json.dumps({"seed": bench.seed, "files": files}, indent=1))
    else:
        click.echo("\n".join([f"seed {bench.seed}", *files]))
