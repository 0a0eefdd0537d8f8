"""The `microid synth` command: the work. It has no use for JAX, so it does not wait for it."""

import json

import click

import data_synth
from fits._errors import DataError


def run_synth(*, scenario: str, out: str, seed: int | None, as_json: bool) -> None:
    """Do `microid synth`; the options are the command's."""
    try:
        bench = data_synth.simulate(data_synth.load_scenario(scenario), seed)
        files = [str(file) for file in data_synth.write(bench, out)]
    except data_synth.ScenarioError as error:
        raise DataError(str(error)) from error
    if as_json:
        click.echo(json.dumps({"seed": bench.seed, "files": files}, indent=1))
    else:
        click.echo("\n".join([f"seed {bench.seed}", *files]))


def scenario_lines() -> list[str]:
    """Say of every scenario what it is."""
    return [f"{name:20} {data_synth.load_scenario(name).description}" for name in data_synth.scenario_names()]
