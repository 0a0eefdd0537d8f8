"""Names that are imported on their first use, so that a command that needs no model does without JAX."""

import ast
import importlib
import importlib.metadata
from collections.abc import Callable
from pathlib import Path
from typing import Any


def late(module: str, file: str) -> tuple[dict[str, str], Callable[[str], Any]]:
    """Read what a module's file imports `if TYPE_CHECKING`: the home of each name, and the module's `__getattr__`."""
    blocks = (node for node in ast.parse(Path(file).read_text(encoding="utf-8")).body if isinstance(node, ast.If))
    imports = (node for block in blocks for node in block.body if isinstance(node, ast.ImportFrom))
    homes = {alias.name: str(node.module) for node in imports for alias in node.names}

    def find(name: str) -> Any:
        # The version is looked up among what is installed, and only where it is asked for.
        if name == "__version__":
            return importlib.metadata.version("microid")
        if name not in homes:
            raise AttributeError(f"module {module!r} has no attribute {name!r}")
        if homes[name] == module:
            return importlib.import_module(f"{module}.{name}")
        return getattr(importlib.import_module(homes[name]), name)

    return homes, find
