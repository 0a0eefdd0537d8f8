"""Refusals of objects of other libraries say what to write in Python, where those of files name options."""

import functools
import os
import re
from collections.abc import Callable
from dataclasses import replace
from typing import ParamSpec, TypeVar

from fits.io._errors import DataError
from fits.io._record import Record, Reference

_Given = ParamSpec("_Given")
_Made = TypeVar("_Made", Record, Reference)
_COLUMNS = re.compile(r"--columns (?:'([^']*)'|([^\s;)]+?)(?=[.;,)]?(?:\s|$)))")


def in_python(read: Callable[_Given, _Made]) -> Callable[_Given, _Made]:
    """Turn the options that a reader's sentences name into its arguments, unless the user named a file."""

    @functools.wraps(read)
    def run(*args: _Given.args, **kwargs: _Given.kwargs) -> _Made:
        if isinstance([*args, *kwargs.values()][0], str | os.PathLike):
            return read(*args, **kwargs)
        try:
            made = read(*args, **kwargs)
        except DataError as error:
            raise DataError(_as_arguments(str(error), read.__name__)) from None
        return replace(made, warnings=tuple(_as_arguments(warning, read.__name__) for warning in made.warnings))

    return run


def _as_arguments(sentence: str, reader: str) -> str:
    def again(arguments: str) -> str:
        return "fits" + f".{reader}(data, {arguments})"

    def pairs(found: re.Match[str]) -> str:
        named = dict(pair.split("=", 1) for pair in (found[1] or found[2]).split(",") if "=" in pair)
        return again(str(named)) if named else "columns"

    sentence = _COLUMNS.sub(pairs, sentence).replace("--missing drop", again('missing="drop"'))
    return sentence.replace("--columns", "columns").replace("--sample-rate", "sample_rate_Hz")
