"""What the commands share: options, and bad input in sentences.

Of other packages only click is imported here and in the `_cli_commands_...` modules; the work, and what it imports,
is in the modules those call.
"""

import functools
import sys
from collections.abc import Callable
from typing import Any, TypeVar

import click

from fits._errors import DataError

# Exit status after Ctrl-C, as shells have it.
INTERRUPTED = 130
_Command = TypeVar("_Command", bound=Callable[..., None])


def in_sentences(command: _Command) -> _Command:
    """Turn bad input and interruption into one line on stderr and an exit status."""

    @functools.wraps(command)
    def run(*args: Any, **kwargs: Any) -> None:
        try:
            command(*args, **kwargs)
        except KeyboardInterrupt:
            click.echo("Interrupted: no unfinished file was left.", err=True)
            sys.exit(INTERRUPTED)
        except DataError as error:
            sentence = " ".join(str(error).split())
            click.echo(sentence if sentence.endswith((".", "?")) else f"{sentence}.", err=True)
            sys.exit(2)

    return run  # type: ignore[return-value]


columns = click.option(
    "--columns",
    metavar="NAME=SOURCE,...",
    default="",
    help="Which columns to read, such as voltage_V=u1_V,displacement_um=-height[nm].",
)
limits = click.option("--limits", metavar="LOW,HIGH", help="Voltages allowed, in V; the model's range by default.")
limit = click.option(
    "--limit",
    multiple=True,
    metavar="NAME=LOW:HIGH",
    help="What the rig may be asked for, such as displacement=0:40um or slew=2kV/s; again for more of voltage, slew, "
    "displacement, velocity, acceleration and current (per farad of the piezo). By default what the runs reached.",
)
margin = click.option(
    "--margin",
    type=float,
    default=0.02,
    show_default=True,
    help="Share of its range by which what is predicted may go beyond what the runs reached.",
)
json_output = click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")
quiet = click.option("--quiet", is_flag=True, help="No progress on stderr.")
