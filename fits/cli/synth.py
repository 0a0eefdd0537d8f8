"""The command `microid synth`: its options, and the work."""

import click

from fits.cli import _common as common
from fits.cli import _options as options
from fits.io._errors import DataError
from fits.io._file_set import file_set


def _list(context: click.Context, _: click.Parameter, wanted: bool) -> None:
    if wanted and not context.resilient_parsing:
        import data_synth

        for name in data_synth.scenario_names():
            click.echo(f"{name:20} {data_synth.load_scenario(name).description}")
        click.echo(f"{data_synth.BOUCWEN:20} The Bouc-Wen benchmark: a noisy multisine, and two tests without noise.")
        context.exit()


@click.command()
@click.argument("scenario")
@options.out_folder
@click.option(
    "--seed", type=click.IntRange(0, 2**64 - 1), help="Seed; the scenario's own by default, and 0 for boucwen."
)
@click.option(
    "--samples",
    type=click.IntRange(100),
    help="First samples that are kept of each record of boucwen; all by default, which takes some 40 s.",
)
@click.option(
    "--list", is_flag=True, expose_value=False, is_eager=True, callback=_list, help="List the scenarios and exit."
)
@options.json_output
@common.in_sentences
def synth(given: common.Given) -> None:
    """Write example CSVs from a virtual test bench.

    SCENARIO is one of those that --list shows, or a .toml file.
    """
    import data_synth

    with file_set() as made:
        folder = made.folder(given.out)
        if given.scenario == data_synth.BOUCWEN:
            seed = given.seed or 0
            contents = data_synth.boucwen_files(seed, given.samples)
        elif given.samples is not None:
            raise DataError("--samples: only the records of boucwen can be cut; a scenario states its runs.")
        else:
            try:
                bench = data_synth.simulate(data_synth.load_scenario(given.scenario), given.seed)
            except data_synth.ScenarioError as error:
                raise DataError(str(error)) from error
            seed, contents = bench.seed, data_synth.files(bench)
        for name, text in contents.items():
            (folder / name).write_bytes(text.encode())
    files = common.paths_in(given.out, contents)
    common.print_result(given, {"seed": seed, "files": files}, [f"seed {seed}", *files])
