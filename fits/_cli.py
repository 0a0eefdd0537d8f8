"""The `microid` command.

Only the standard library and click are imported before a command runs.
"""

import os
import sys

import click

from fits._cli_commands_control import control
from fits._cli_commands_diagnosis import diagnose
from fits._cli_commands_model import compensate, export, fit, info, simulate, synth
from fits._cli_commands_paper import paper
from fits._cli_commands_stage import budget, sensitivity
from fits._cli_commands_sweep import sweep
from fits._cli_common import INTERRUPTED


def _show_version(context: click.Context, _: click.Parameter, wanted: bool) -> None:
    if wanted and not context.resilient_parsing:
        from fits._version import written_by

        click.echo(written_by())
        context.exit()


@click.group(context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100})
@click.option(
    "--version",
    is_flag=True,
    expose_value=False,
    is_eager=True,
    callback=_show_version,
    help="Show the version and exit.",
)
def cli() -> None:
    """Identify a piezo-driven micro-positioner from CSV files of voltage and displacement.

    Bad input ends with status 2 and one sentence on stderr. Compiled functions are kept in the user's cache folder;
    MICROID_CACHE names another, and MICROID_CACHE=off keeps none.
    """


for _command in (
    fit,
    simulate,
    compensate,
    export,
    synth,
    info,
    sensitivity,
    budget,
    diagnose,
    control,
    paper,
    sweep,
):
    cli.add_command(_command)


def main() -> None:
    """Run the command."""
    try:
        cli(prog_name="microid")
    except SystemExit as stop:
        if stop.code == INTERRUPTED:
            # All that is kept is written. Threads that still compile crash an interpreter that is taken down.
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(INTERRUPTED)
        raise
