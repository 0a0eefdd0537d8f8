"""Plug-ins of readers: one file each, in a folder that imports all of them.

`microid` has the same for its models; to take it from there would start JAX to read a file.
"""

import importlib
import pkgutil
from collections.abc import Iterable


def import_all(package: str, folders: Iterable[str]) -> None:
    """Import every module of a package, by its `__name__` and `__path__`, but those that begin with an underscore."""
    for found in pkgutil.iter_modules(folders):
        if not found.name.startswith("_"):
            importlib.import_module(f"{package}.{found.name}")
