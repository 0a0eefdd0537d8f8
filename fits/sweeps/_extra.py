"""Packages that only sweeps need, and what to install where they are missing."""

import importlib
from typing import Any

from fits.io._errors import DataError

_EXTRA = {"distributed": "cluster"}


def need(name: str) -> Any:
    """Import a package of the extras `sweep` and `cluster`; a `DataError` says what to run if it is not installed."""
    try:
        return importlib.import_module(name)
    except ImportError:
        extra = _EXTRA.get(name.partition(".")[0], "sweep")
        extras = "sweep" if extra == "sweep" else f"sweep,{extra}"
        raise DataError(
            f"this needs the package {name.partition('.')[0]}, which is not installed; run: pip install "
            f'"microid[{extras}]"'
        ) from None
