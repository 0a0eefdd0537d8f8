"""What is imported by its name: names on their first use, plug-ins of readers, and packages of the extras.

`microid` has the same for its own plug-ins; to take it from there would start JAX to read a file.
"""

import ast
import importlib
import importlib.metadata
import pkgutil
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from fits.io._errors import DataError


def late(module: str, file: str) -> tuple[dict[str, str], Callable[[str], Any]]:
    """Read what a module's file imports `if TYPE_CHECKING`: the home of each name, and the module's `__getattr__`."""
    blocks = (node for node in ast.parse(Path(file).read_text(encoding="utf-8")).body if isinstance(node, ast.If))
    imports = (node for block in blocks for node in block.body if isinstance(node, ast.ImportFrom))
    homes = {alias.name: str(node.module) for node in imports for alias in node.names}

    def find(name: str) -> Any:
        if name == "__version__":
            return importlib.metadata.version("microid")
        if name not in homes:
            raise AttributeError(f"module {module!r} has no attribute {name!r}")
        return getattr(importlib.import_module(homes[name]), name)

    return homes, find


def import_all(package: str, folders: Iterable[str]) -> None:
    """Import every module of a package, by its `__name__` and `__path__`, but those that begin with an underscore."""
    for found in pkgutil.iter_modules(folders):
        if not found.name.startswith("_"):
            importlib.import_module(f"{package}.{found.name}")


def need(name: str, extras: str) -> Any:
    """Import a package of some extras, such as `io`; a `DataError` says what to run if it is not installed."""
    try:
        return importlib.import_module(name)
    except ImportError:
        package = name.partition(".")[0]
        raise DataError(
            f'this needs the package {package}, which is not installed; run: pip install "microid[{extras}]"'
        ) from None
