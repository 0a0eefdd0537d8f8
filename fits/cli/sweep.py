"""The command `microid sweep`: its options, and the work."""

import click

from fits.cli import _common as common
from fits.cli import _late as late
from fits.cli import _options as options
from fits.io._file_set import file_set
from fits.sweeps import kinds


class _Sweep(click.Group):
    """A group whose first word may also be a file."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Take what is no command and no option of the group for the file of a sweep and its options."""
        if args and args[0] not in self.commands and args[0].partition("=")[0] not in ("--example", "--help", "-h"):
            args = ["run", *args]
        return super().parse_args(ctx, args)

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Show the options of a run of a file, too, whose command nobody names."""
        super().format_options(ctx, formatter)
        shown = (each.get_help_record(ctx) for each in self.commands["run"].params if isinstance(each, click.Option))
        with formatter.section("Options with SWEEP.toml"):
            formatter.write_dl([one for one in shown if one is not None])


@click.group(cls=_Sweep, invoke_without_command=True, subcommand_metavar="SWEEP.toml | show DIR [OPTIONS]")
@click.option(
    "--example", type=click.Choice([*kinds.examples()]), help="Print a commented SWEEP.toml of about 1,000 rows."
)
@click.pass_context
def sweep(context: click.Context, example: str | None) -> None:
    """Simulate, fit, diagnose or control many variants of a stage: thousands to millions of rows.

    microid sweep SWEEP.toml --out DIR computes all rows in chunks; stopped at any moment, the same command with
    --resume goes on. microid sweep show DIR says how far it is and what came out.
    """
    if example is not None:
        click.echo(kinds.examples()[example].read_text(encoding="utf-8"), nl=False)
        context.exit()
    if context.invoked_subcommand is None:
        click.echo(context.get_help())


@sweep.command(hidden=True)
@click.argument("file", metavar="SWEEP.toml")
@click.option("--out", required=True, metavar="DIR", help="Folder for the results; it is made if need be.")
@click.option("--resume", is_flag=True, help="Go on with the sweep that is in DIR.")
@click.option(
    "--cluster", metavar="ADDRESS|local:N", help="A Dask scheduler, or N processes of this machine, to compute on."
)
@options.json_output
@common.in_sentences
def run(given: common.Given) -> None:
    """Run SWEEP.toml.

    DIR will hold results.zarr, which xarray opens, results.parquet, and what is needed to go on. A row that fails is
    kept with its reason and stops nothing else. Without --cluster all is computed in this process.
    """
    late.start_jax(accelerator=True)
    progress = common.progress_to_stderr(given.quiet)
    sweep = late.read_sweep(given.file)
    try:
        outcome = late.run_sweep(sweep, given.out, resume=given.resume, cluster=given.cluster, progress=progress)
    except KeyboardInterrupt as stop:
        common.stopped(stop, "what was computed is kept; go on with --resume")
    content = {
        "out": given.out,
        "rows": outcome.rows,
        "failed": outcome.failed,
        "computed": outcome.computed,
        "chunks_computed_again": outcome.again,
        "seconds": outcome.seconds,
        "files": common.paths_in(given.out, (late.RESULTS, late.TABLE)),
    }
    failed = f", {outcome.failed:,} of them failed" if outcome.failed else ""
    line = f"{outcome.rows:,} rows{failed}; {outcome.computed:,} computed in {outcome.seconds:.1f} s"
    common.print_result(given, content, [line, *(f"results  {name}" for name in content["files"])])


@sweep.command()
@click.argument("folder", metavar="DIR")
@click.option("--best", metavar="OUTPUT", help="Output by which rows are ranked; the first by default.")
@click.option("--largest", is_flag=True, help="Large is good.")
@options.plots("heat maps, parallel coordinates and a page of them")
@options.json_output
@common.in_sentences
def show(given: common.Given) -> None:
    """Say how far the sweep in DIR is, and what came out."""
    summary = late.summarise(given.folder, given.best, given.largest)
    with file_set() as files:
        drawings = files.folder(given.plots)
        drawn, words = [], late.describe_sweep(summary)
        if drawings is not None:
            drawn = late.plot_sweep(given.folder, drawings, given.best, form=given.form)
            late.write_page(drawings, f"Sweep in {given.folder}", words, drawn)
    places = [f"plot  {place}" for place in common.paths_in(given.plots, drawn)]
    common.print_result(given, summary, [words, *places, *common.page(given)])
