"""What the commands share: bad input and interruptions in sentences.

Of other packages only click is imported before a command runs, so that help does not wait for JAX.
"""

import errno
import functools
import os
import signal
import sys
import threading
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, NoReturn

import click

from fits.io._errors import DataError
from fits.io._file_set import discard_all
from fits.io._printable import printable

# Signals that ask the command to end.
_SIGNALS = ("SIGTERM", "SIGHUP")
_AGAIN_s = 0.05


class Terminated(KeyboardInterrupt):
    """A signal, by its number, that asks the command to end; what cleans up after Ctrl-C does so after this."""

    def __init__(self, number: int):
        super().__init__()
        self.number = number


def heed_signals() -> None:
    """Let a request to end clean up as Ctrl-C does; one that is ignored, as under `nohup`, stays ignored."""

    def stop(number: int, _: object) -> None:
        raise Terminated(number)

    for name in _SIGNALS:
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) is signal.SIG_DFL:
            signal.signal(number, stop)
    sys.unraisablehook = _again


def _again(lost: Any) -> None:
    """Send a signal again whose exception came while Python ran a finaliser or a callback, where it goes nowhere."""
    stop = lost.exc_value
    if not isinstance(stop, KeyboardInterrupt):
        sys.__unraisablehook__(lost)
        return
    number = stop.number if isinstance(stop, Terminated) else signal.SIGINT
    timer = threading.Timer(_AGAIN_s, os.kill, (os.getpid(), number))
    timer.daemon = True
    timer.start()


def stopped(stop: KeyboardInterrupt, what: str) -> NoReturn:
    """Say that the command was stopped, and what is left, and end with the status that shells have for it."""
    discard_all()
    by_signal = isinstance(stop, Terminated)
    click.echo(f"{'Terminated' if by_signal else 'Interrupted'}: {what}.", err=True)
    raise Stopped(128 + (stop.number if isinstance(stop, Terminated) else signal.SIGINT))


def system_refuses(error: OSError) -> NoReturn:
    """Say what the system does not allow, such as more on a full disk, and end with status 2."""
    if error.errno == errno.EPIPE:
        raise error  # click ends without a word: who reads has read enough
    place = error.filename if isinstance(error.filename, str) else "output"
    sentence = f"{printable(place)}: the system refuses it ({error.strerror or error}); mend that and start again."
    click.echo(sentence, err=True)
    sys.exit(2)


class Stopped(SystemExit):
    """The end of a command that was stopped."""


class Given(SimpleNamespace):
    """What a command was given, by the names of its options."""

    def __getattr__(self, name: str) -> Any:
        raise AttributeError(f"the command declares no option {name!r}")


def in_sentences(command: Callable[[Given], None]) -> Callable[..., None]:
    """Hand a command its options in one piece; bad input and interruption end in one line on stderr and a status."""

    @functools.wraps(command)
    def run(**options: Any) -> None:
        try:
            command(Given(**options))
        except KeyboardInterrupt as stop:
            stopped(stop, "no unfinished file was left")
        except DataError as error:
            sentence = printable(" ".join(str(error).split()))
            click.echo(sentence if sentence.endswith((".", "?")) else f"{sentence}.", err=True)
            sys.exit(2)
        except OSError as error:
            system_refuses(error)

    return run
