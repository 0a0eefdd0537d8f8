"""The `microid synth` command: the work. It has no use for JAX, so it does not wait for it."""

import json
from pathlib import Path

import click

import data_synth
from fits.io._errors import DataError
from fits.io._file_set import file_set


def run_synth(*, scenario: str, out: str, seed: int | None, as_json: bool) -> None:
    """Do `microid synth`; the options are the command's."""
    with file_set() as made:
        # Before the work, so that a place that cannot be written to is refused before the wait.
        folder = made.folder(out, "--out")
        try:
            bench = data_synth.simulate(data_synth.load_scenario(scenario), seed)
        except data_synth.ScenarioError as error:
            raise DataError(str(error)) from error
        contents = data_synth.files(bench)
        for name, text in contents.items():
            (folder / name).write_bytes(text.encode())
    files = [str(Path(out) / name) for name in contents]
    if as_json:
        click.echo(json.dumps({"seed": bench.seed, "files": files}, indent=1))
    else:
        click.echo("\n".join([f"seed {bench.seed}", *files]))


def scenario_lines() -> list[str]:
    """Say of every scenario what it is."""
    return [f"{name:20} {data_synth.load_scenario(name).description}" for name in data_synth.scenario_names()]
