"""The kinds of jobs there are, and how each is made from a sweep's text."""

import importlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fits.sweeps._types import AbstractJob


@dataclass(frozen=True)
class Request:
    """What a job is made from.

    Attributes
    ----------
    table
        The sweep as TOML gives it.
    names, relative
        What varies, in the order of the plan, and which of it as factors.
    load
        Gives the content of a file by its name in the sweep.
    folder
        Where patterns of file names start; None on a worker, where `sources` are given.
    """

    table: Mapping[str, Any]
    names: tuple[str, ...]
    relative: tuple[str, ...]
    load: Callable[[str], bytes]
    folder: Path | None


@dataclass(frozen=True)
class Kind:
    """A kind of job: the keys of the sweep that are its own, and the module that makes it."""

    tables: tuple[str, ...]
    module: str

    def make(self, request: Request) -> AbstractJob:
        """Make the job; a `DataError` says what is wrong with the request."""
        made: AbstractJob = importlib.import_module(self.module).make(request)
        return made


KINDS = {
    "simulate": Kind(("model", "initial", "program", "outputs"), "fits.sweeps._kinds_simulate"),
    "sensitivity": Kind(("stage", "sensitivity"), "fits.sweeps._kinds_sensitivity"),
    "fit": Kind(("model", "initial", "program", "records", "fit"), "fits.sweeps._kinds_fit"),
    "diagnose": Kind(("model", "initial", "program", "records", "diagnose"), "fits.sweeps._kinds_diagnose"),
    "control": Kind(("model", "initial", "reference", "controller"), "fits.sweeps._kinds_control"),
}
