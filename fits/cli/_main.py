"""The `microid` command: only the standard library and click are imported before one of its commands runs."""

import importlib
import io
import pkgutil
import sys
from typing import Any

import click

import fits.cli
from fits.cli._common import NOTHING_LEFT, Stopped, heed_signals, leave, stopped, system_refuses
from fits.io._errors import without_middle
from fits.io._version import written_by


class _Commands(click.Group):
    """Commands whose refusals of options quote what was typed, but not at any length, and whose help is whole."""

    def invoke(self, ctx: click.Context) -> Any:
        try:
            return super().invoke(ctx)
        except click.UsageError as error:
            raise click.UsageError(without_middle(error.format_message()), error.ctx) from None

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write what each command is for, whole, where click would cut it."""
        words = {name: command.get_short_help_str(limit=1000) for name, command in sorted(self.commands.items())}
        with formatter.section("Commands"):
            formatter.write_dl(list(words.items()))


@click.group(cls=_Commands, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100})
@click.version_option(written_by(), message="%(version)s")
def cli() -> None:
    """Identify a piezo-driven micro-positioner from records of voltage and displacement.

    Bad input ends with status 2 and one sentence on stderr. Compiled functions are kept in the user's cache folder;
    MICROID_CACHE names another, and MICROID_CACHE=off keeps none.
    """


for _found in pkgutil.iter_modules(fits.cli.__path__):
    # A file whose name has no underscore holds the command of its name.
    if not _found.name.startswith("_"):
        cli.add_command(getattr(importlib.import_module(f"fits.cli.{_found.name}"), _found.name))


def main() -> None:
    """Run the command."""
    heed_signals()
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            # What cannot be shown, such as half a character in a file's name, is written as its code.
            stream.reconfigure(errors="backslashreplace")
    try:
        try:
            # By itself click would end with status 1 where it is stopped between its own calls of a command.
            status = cli(prog_name="microid", standalone_mode=False)
            sys.exit(status if isinstance(status, int) else 0)
        except click.ClickException as error:
            error.show()
            sys.exit(error.exit_code)
        except click.Abort as abort:
            stop = abort.__cause__
            stopped(stop if isinstance(stop, KeyboardInterrupt) else KeyboardInterrupt(), NOTHING_LEFT)
        except KeyboardInterrupt as stop:
            stopped(stop, NOTHING_LEFT)
        except OSError as error:
            system_refuses(error)
    except Stopped as stop:
        leave(stop)
