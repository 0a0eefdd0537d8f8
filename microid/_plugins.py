"""Plug-ins: one file each, in a folder that imports all of them."""

import importlib
import pkgutil
from collections.abc import Iterable
from types import ModuleType


def plugins(package: str, folders: Iterable[str]) -> list[ModuleType]:
    """Import every module of a package whose name does not start with an underscore, in alphabetical order.

    Parameters
    ----------
    package
        Its `__name__`.
    folders
        Its `__path__`.
    """
    names = sorted(found.name for found in pkgutil.iter_modules(folders) if not found.name.startswith("_"))
    return [importlib.import_module(f"{package}.{name}") for name in names]
