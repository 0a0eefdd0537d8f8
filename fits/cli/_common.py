"""What the commands share: bad input and interruptions in sentences, places to read and write, and what is told."""

import contextlib
import errno
import functools
import logging
import math
import os
import re
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from enum import StrEnum
from pathlib import Path
from types import FrameType, SimpleNamespace
from typing import Any, NoReturn

import click
from click.core import ParameterSource

from fits.cli import _late as late
from fits.io._errors import DataError, without_middle
from fits.io._file_set import discard_all
from fits.io._printable import printable

NOTHING_LEFT = "no unfinished file was left"
_LOG = logging.getLogger("fits")
# Beyond this a command says what it does.
_SILENCE_s = 2.0
_LENGTH = re.compile(r"\s*([0-9.eE+-]+)\s*([a-zµμ]+)\s*")


class Terminated(KeyboardInterrupt):
    """A signal, by its number, that asks the command to end; what cleans up after Ctrl-C does so after this."""

    def __init__(self, number: int):
        super().__init__()
        self.number = number


def heed_signals() -> None:
    """Let a request to end clean up as Ctrl-C does; one that is ignored, as under `nohup`, stays ignored."""

    def stop(number: int, frame: FrameType | None) -> None:
        request = KeyboardInterrupt() if number == signal.SIGINT else Terminated(number)
        if not _is_importing(frame):
            raise request
        # What is being imported may wrap an exception in another, or end in C++ with a crash.
        try:
            stopped(request, NOTHING_LEFT)
        except Stopped as end:
            leave(end)

    for name in ("SIGTERM", "SIGHUP", "SIGINT"):
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) in (signal.SIG_DFL, signal.default_int_handler):
            signal.signal(number, stop)
    sys.unraisablehook = _again


def _is_importing(frame: FrameType | None) -> bool:
    """Whether a module is being imported in a frame, or in one that called it."""
    while frame is not None and frame.f_globals.get("__name__") != "importlib._bootstrap":
        frame = frame.f_back
    return frame is not None


def leave(stop: "Stopped") -> NoReturn:
    """End at once: all that is kept is written, and threads that still compile crash an interpreter taken down."""
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, AttributeError):
            stream.flush()
    os._exit(int(str(stop.code)))


def _again(lost: Any) -> None:
    """Send a signal again whose exception came while Python ran a finaliser or a callback, where it goes nowhere."""
    stop = lost.exc_value
    if not isinstance(stop, KeyboardInterrupt):
        sys.__unraisablehook__(lost)
        return
    number = stop.number if isinstance(stop, Terminated) else signal.SIGINT
    timer = threading.Timer(0.05, os.kill, (os.getpid(), number))
    timer.daemon = True
    timer.start()


def stopped(stop: KeyboardInterrupt, what: str) -> NoReturn:
    """Say that the command was stopped, and what is left, and end with the status that shells have for it."""
    discard_all()
    said, number = ("Terminated", stop.number) if isinstance(stop, Terminated) else ("Interrupted", signal.SIGINT)
    click.echo(f"{said}: {what}.", err=True)
    raise Stopped(128 + number)


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


@contextlib.contextmanager
def _logged(verbose: bool) -> Iterator[None]:
    """Pass on to stderr, if asked, what `fits` logs: files read and written, JAX, and where an error came from."""
    handler = logging.StreamHandler() if verbose else logging.NullHandler()
    _LOG.addHandler(handler)
    _LOG.setLevel(logging.DEBUG if verbose else logging.WARNING)
    try:
        yield
    except (DataError, RuntimeError, OSError):
        _LOG.debug("it was refused here:", exc_info=True)
        raise
    finally:
        _LOG.removeHandler(handler)


def _refuse_idle_format(options: dict[str, Any]) -> None:
    """Refuse a format of pictures that are not asked for."""
    if options.get("plots", "") is not None:
        return
    if click.get_current_context().get_parameter_source("form") is ParameterSource.COMMANDLINE:
        raise DataError("--format: expected --plots with it, the folder for the pictures; give one, or leave it out.")


def in_sentences(command: Callable[[Given], None]) -> Callable[..., None]:
    """Hand a command its options in one piece; bad input and interruption end in one line on stderr and a status.

    Every command has the options that say how much it tells.
    """

    @click.option("-q", "--quiet", is_flag=True, help="No progress on stderr.")
    @click.option("-v", "--verbose", is_flag=True, help="Log what is read, written and refused, on stderr.")
    @functools.wraps(command)
    def run(verbose: bool = False, **options: Any) -> None:
        try:
            with _logged(verbose):
                _refuse_idle_format(options)
                command(Given(**options))
        except KeyboardInterrupt as stop:
            stopped(stop, NOTHING_LEFT)
        except (DataError, RuntimeError) as error:
            if isinstance(error, RuntimeError) and not isinstance(error, late.FitError):
                raise
            of_model = isinstance(error, DataError) and error.of_model
            place = options.get("start") or options.get("model") if of_model else None
            sentence = printable(" ".join(without_middle(f"{place}: {error}" if place else str(error)).split()))
            click.echo(sentence if sentence.endswith((".", "?")) else f"{sentence}.", err=True)
            sys.exit(2)
        except OSError as error:
            # An interruption just after a file was closed makes `shutil.rmtree` close it again, whose error hides it.
            if error.errno == errno.EBADF and isinstance(error.__context__, KeyboardInterrupt):
                stopped(error.__context__, NOTHING_LEFT)
            system_refuses(error)

    return run


def progress_to_stderr(quiet: bool, stages: Sequence[StrEnum] = ()) -> Callable[[str], None]:
    """Make what tells on stderr what is being done, and since when.

    Where there are stages, which are announced by themselves, a bar has a step for each; other sentences tell of
    details. On a terminal the bar stays in its line; elsewhere each sentence has its own.
    """
    began, at = time.monotonic(), 0

    def tell(sentence: str) -> None:
        nonlocal at
        if quiet:
            return
        at = max(at, stages.index(sentence) + 1) if isinstance(sentence, StrEnum) else at
        bar = f"[{'#' * at}{'.' * (len(stages) - at)}] " if stages else ""
        line = f"{bar}{time.monotonic() - began:6.1f} s  {sentence}"
        stays = bool(stages) and sys.stderr is not None and sys.stderr.isatty()
        click.echo(f"\r\033[K{line}" if stays else line, nl=not stays or at == len(stages), err=True)

    return tell


def now_and_then(tell: Callable[[str], None]) -> Callable[[str], None]:
    """Pass a sentence on if some seconds have passed since the last: nothing of what is soon done."""
    latest = time.monotonic()

    def maybe(sentence: str) -> None:
        nonlocal latest
        if time.monotonic() - latest > _SILENCE_s:
            latest = time.monotonic()
            tell(sentence)

    return maybe


def print_result(given: Given, content: Any, lines: Iterable[str]) -> None:
    """Print a result: as JSON where that is asked for, else in lines."""
    click.echo(late.finite_json(content) if given.as_json else "\n".join(lines))


def reading(given: Given) -> dict[str, Any]:
    """How files are to be read, as `read_table` takes it."""
    columns = late.parse_columns(given.columns)
    return {"columns": columns, "sample_rate_Hz": given.sample_rate, "missing": given.missing}


def paths_in(folder: str | None, made: Iterable[str | Path]) -> list[str]:
    """Names of the files that were made for a folder, as the user named it."""
    return [str(Path(folder or "") / Path(file).name) for file in made]


def page(given: Given) -> list[str]:
    """The line on the page beside the pictures, where some are asked for."""
    return [] if given.plots is None else [f"page   {Path(given.plots) / 'index.html'}"]


def with_places(words: str, places: Iterable[tuple[str, str | None]]) -> list[str]:
    """Words, then lines of what was written where; what was not written has no place."""
    written = [f"{what:5}  {place}" for what, place in places if place is not None]
    return [words, *([""] if written else []), *written]


def fraction_or_files(given: Sequence[str]) -> tuple[float, list[str]]:
    """Tell a fraction from files."""
    if not given:
        return 0.2, []
    numbers = []
    for text in given:
        with contextlib.suppress(ValueError):
            numbers.append(float(text))
    if not numbers:
        return 0.0, list(given)
    if len(given) > 1:
        raise DataError("--holdout: expected one fraction, or files only, found a fraction with others; choose one.")
    if not 0 <= numbers[0] <= 0.9:
        raise DataError(f"--holdout: expected a fraction between 0 and 0.9 or a file, found {given[0]}.")
    return numbers[0], []


def length_mm(option: str, text: str, units: Sequence[str], example: str) -> float:
    """Read a length with one of some units, such as `0.02mm`, in mm."""
    length = late.Quantity("length", "mm", {"mm": 0, "um": -3, "µm": -3, "μm": -3, "m": 3})
    found, number = _LENGTH.fullmatch(text), 0.0
    if found and found[2] in units:
        with contextlib.suppress(ValueError):
            number = float(found[1])
    if not (found and 0 < number < float("inf")):
        raise DataError(
            f"{option}: expected a length above 0 with its unit, found '{text}'; write one such as {example}."
        )
    return float(length.convert(number, found[2]))


def refuse_overwriting(out: str, inputs: Iterable[str]) -> None:
    """Refuse to overwrite what is read."""
    for path in inputs:
        if os.path.realpath(late.numbered(path)[0]) == os.path.realpath(out):
            raise DataError(f"--out: {out} would overwrite what is read; choose another name.")


def refuse_clashes(places: dict[str, str | None]) -> None:
    """Refuse to write where is read, or twice to one place."""
    seen: dict[str, str] = {}
    for option, place in places.items():
        if place is not None and (first := seen.setdefault(os.path.realpath(place), option)) != option:
            raise DataError(f"{option}: {place} would overwrite the file of {first}; choose another name.")


def stage_or_preisach(path: str, loaded: "late.ModelFile") -> "late.Preisach | late.Stage":
    """Return the stage or the hysteresis that a model file holds; a `DataError` where it holds neither."""
    if isinstance(loaded.model, late.Preisach | late.Stage):
        return loaded.model
    raise DataError(f"{path}: expected a Preisach model, found a {type(loaded.model).__name__}; fit one first.")


def opened(path: str, plain: bool = True) -> "late.ModelFile | late.PlainModel":
    """Read a model: without JAX where `plain_model` can, and what is asked for is plain."""
    content = late.read_model_text(path)
    found = late.plain_model(content) if plain else None
    if found is not None:
        return found
    late.start_jax()
    return late.load_model(path)


def predicted_by(
    path: str,
    loaded: "late.ModelFile | late.PlainModel",
    program: "late.Record",
    initial: "late.Initial",
    progress: Callable[[str], None] = lambda _: None,
) -> "late.Prediction":
    """Predict with whatever model a file holds; without an uncertainty the standard deviations are NaN."""
    if isinstance(loaded, late.PlainModel):
        return loaded.predict(program, initial, progress)
    model = stage_or_preisach(path, loaded)
    if loaded.uncertainty is None and isinstance(model, late.Preisach):
        raise DataError(f"{path}: the file lacks the uncertainty of its model; fit again.")
    return late.predict(model, program, initial, uncertainty=loaded.uncertainty)


def parse_rig_limits(
    volts: str | None, limit: Sequence[str], margin: float
) -> tuple[tuple[float, float] | None, dict[str, tuple[float, float]]]:
    """Read `--limits`, `--limit` and `--margin`: the range of the command in V, and what else is stated."""
    stated = late.parse_limits(limit)
    late.allowed({}, stated, margin)
    both = parse_limits_V(volts)
    if "voltage" in stated and both is not None:
        raise DataError("--limit voltage: --limits states that already; leave one of them out.")
    return both or stated.get("voltage"), stated


def parse_limits_V(text: str | None) -> tuple[float, float] | None:
    """Read `--limits`: two voltages, or None."""
    if text is None:
        return None
    try:
        low, high = (float(part) for part in text.split(","))
    except ValueError:
        raise DataError(
            f"--limits: expected two voltages such as 0,100, found '{text}'; write LOW,HIGH in V."
        ) from None
    if not (math.isfinite(low) and math.isfinite(high) and low < high):
        raise DataError(
            f"--limits: expected two finite voltages, the lower one first, found '{text}'; write LOW,HIGH in V."
        )
    return low, high
