"""The readers as Python has them: their sentences say what to write there, where the command names options."""

import functools
import os
import re
from collections.abc import Callable
from dataclasses import replace
from typing import Any, ParamSpec, TypeVar, cast

from fits.io import _read_csv
from fits.io._errors import DataError
from fits.io._record import Record, Reference

_Given = ParamSpec("_Given")
_Made = TypeVar("_Made", Record, Reference, tuple[Record, ...])
_COLUMNS = re.compile(r"--columns (?:'([^']*)'|([^\s;)]+?)(?=[.;,)]?(?:\s|$)))")


def _in_python(read: Callable[_Given, _Made]) -> Callable[_Given, _Made]:
    """Turn the options that a reader's sentences name into its arguments."""

    def renamed(made: Any, call: str) -> Any:
        return replace(made, warnings=tuple(_as_arguments(warning, call) for warning in made.warnings))

    @functools.wraps(read)
    def run(*args: _Given.args, **kwargs: _Given.kwargs) -> _Made:
        source = [*args, *kwargs.values()][0]
        named = repr(os.fspath(source)) if isinstance(source, str | os.PathLike) else "data"
        call = "fits" + f".{read.__name__}({named}"
        try:
            made = read(*args, **kwargs)
        except DataError as error:
            raise DataError(_as_arguments(str(error), call)) from None
        found = tuple(renamed(one, call) for one in made) if isinstance(made, tuple) else renamed(made, call)
        return cast(_Made, found)

    run.__module__ = __name__
    return run


def _as_arguments(sentence: str, call: str) -> str:
    def pairs(found: re.Match[str]) -> str:
        named = dict(pair.split("=", 1) for pair in (found[1] or found[2]).split(",") if "=" in pair)
        return f"{call}, {named})" if named else found[0]

    sentence = _COLUMNS.sub(pairs, sentence).replace("--missing drop", f'{call}, missing="drop")')
    return sentence.replace("--columns", "columns").replace("--sample-rate", "sample_rate_Hz")


read_table = _in_python(_read_csv.read_table)
# What it was called when it read CSV alone.
read_csv = read_table
read_runs = _in_python(_read_csv.read_runs)
read_reference = _in_python(_read_csv.read_reference)
