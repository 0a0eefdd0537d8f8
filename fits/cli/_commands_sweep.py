"""The command that runs many rows at once: its options."""

from typing import Any

import click

from fits.cli._common import in_sentences, json_output, quiet


class _Sweep(click.Group):
    """A group whose first word may also be a file."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Take what is no command and no option of the group for the file of a sweep and its options."""
        if args and args[0] not in self.commands and args[0].partition("=")[0] not in ("--example", "--help", "-h"):
            args = ["run", *args]
        return super().parse_args(ctx, args)


@click.group(cls=_Sweep, invoke_without_command=True, subcommand_metavar="SWEEP.toml | show DIR [OPTIONS]")
@click.option(
    "--example",
    type=click.Choice(["simulate", "sensitivity", "fit", "diagnose", "control"]),
    help="Print a commented SWEEP.toml of about 1,000 rows.",
)
@click.pass_context
def sweep(context: click.Context, example: str | None) -> None:
    """Simulate, fit, diagnose or control many variants of a stage: thousands to millions of rows.

    microid sweep SWEEP.toml --out DIR computes all rows in chunks; stopped at any moment, the same command with
    --resume goes on. microid sweep show DIR says how far it is and what came out.
    """
    if example is not None:
        from fits.sweeps._examples import EXAMPLES

        click.echo(EXAMPLES[example], nl=False)
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
@json_output
@quiet
@in_sentences
def run(**options: Any) -> None:
    """Run SWEEP.toml.

    DIR will hold results.zarr, which xarray opens, results.parquet, and what is needed to go on. A row that fails is
    kept with its reason and stops nothing else. Without --cluster all is computed in this process.
    """
    from fits.cli._sweep import run_sweep

    run_sweep(**options)


@sweep.command()
@click.argument("folder", metavar="DIR")
@click.option("--best", metavar="OUTPUT", help="Output by which rows are ranked; the first by default.")
@click.option("--largest", is_flag=True, help="Large is good.")
@click.option("--plots", metavar="DIR", help="Folder for heat maps and parallel coordinates; it is made if need be.")
@json_output
@in_sentences
def show(**options: Any) -> None:
    """Say how far the sweep in DIR is, and what came out."""
    from fits.cli._sweep import show_sweep

    show_sweep(**options)
