"""The command `microid paper`: its options, and the work."""

import click

from fits.cli import _common as common
from fits.cli import _late as late
from fits.cli import _options as options
from fits.io._file_set import file_set


@click.command()
@options.out_folder
@click.option(
    "--seeds", type=click.IntRange(1, 100), default=10, show_default=True, help="How many noises to go through."
)
@click.option("--seed", type=options.SEEDS, default=0, show_default=True, help="Where all randomness starts.")
@options.picture_format("the pictures")
@options.json_output
@common.in_sentences
def paper(given: common.Given) -> None:
    """Repeat the paper's compensation on a virtual stage: its tables and figures beside ours.

    Writes paper.md with pictures, and paper.json. The stage is identified from noisy CSVs, then run open, under
    feedforward, and with each of the paper's three controllers.
    """
    late.start_jax()
    progress = common.progress_to_stderr(given.quiet)
    with file_set() as files:
        result = late.paper_result(given.seeds, given.seed, files.folder(given.out), progress, given.form)
    page, figures = common.paths_in(given.out, ("paper.md", "paper.json"))
    worse = result.worse()
    lines = [f"page   {page}", f"json   {figures}", f"worse than the paper: {'; '.join(worse) or 'no row'}"]
    common.print_result(given, {"out": given.out, "files": [page, figures], "worse_than_paper": worse}, lines)
