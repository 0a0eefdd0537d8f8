"""The command `microid synth`: its options, and the work."""

import click

from fits.cli import _common as common
from fits.cli import _options as options
from fits.io._errors import DataError
from fits.io._file_set import file_set
from fits.io._typed import nearest


@click.command()
@click.argument("scenario", required=False)
@click.option("--out", metavar="DIR", help="Folder to write to; it is made if need be. Needed, except to list.")
@click.option(
    "--seed", type=click.IntRange(0, 2**64 - 1), help="Seed; the scenario's own by default, and 0 for boucwen."
)
@click.option(
    "--samples",
    type=click.IntRange(100),
    help="First samples that are kept of each record of boucwen; all by default, which takes some 40 s.",
)
@click.option("--list", "listed", is_flag=True, help="List the scenarios, and write nothing.")
@options.json_output
@common.in_sentences
def synth(given: common.Given) -> None:
    """Write example CSVs from a virtual test bench.

    SCENARIO is one of those that --list shows, or a .toml file.
    """
    import data_synth

    if given.listed:
        about = {name: data_synth.load_scenario(name).description for name in data_synth.scenario_names()}
        about[data_synth.BOUCWEN] = "The Bouc-Wen benchmark: a noisy multisine, and two tests without noise."
        common.print_result(given, about, [f"{name:20} {words}" for name, words in about.items()])
        return
    if given.scenario is None or given.out is None:
        raise DataError("synth: expected a SCENARIO and --out DIR; --list shows the scenarios.")
    with file_set() as made:
        folder = made.folder(given.out)
        if given.scenario == data_synth.BOUCWEN:
            seed = given.seed or 0
            contents = data_synth.boucwen_files(seed, given.samples)
        elif given.samples is not None:
            raise DataError("--samples: only the records of boucwen can be cut; a scenario states its runs.")
        else:
            known = [*data_synth.scenario_names(), data_synth.BOUCWEN]
            if not given.scenario.endswith(".toml") and given.scenario not in known:
                raise DataError(f"no scenario is called '{given.scenario}': {nearest(given.scenario, known)}")
            try:
                bench = data_synth.simulate(data_synth.load_scenario(given.scenario), given.seed)
            except data_synth.ScenarioError as error:
                raise DataError(str(error)) from error
            seed, contents = bench.seed, data_synth.files(bench)
        for name, text in contents.items():
            (folder / name).write_bytes(text.encode())
    files = common.paths_in(given.out, contents)
    common.print_result(given, {"seed": seed, "files": files}, [f"seed {seed}", *files])
