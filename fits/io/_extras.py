"""Packages of the extras, which are imported when they are needed."""

import importlib
from typing import Any

from fits.io._errors import DataError


def need(name: str, extras: str) -> Any:
    """Import a package of some extras, such as `io`; a `DataError` says what to run if it is not installed."""
    try:
        return importlib.import_module(name)
    except ImportError:
        package = name.partition(".")[0]
        raise DataError(
            f'this needs the package {package}, which is not installed; run: pip install "microid[{extras}]"'
        ) from None
