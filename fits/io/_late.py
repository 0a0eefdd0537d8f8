"""Names that a module takes from others only when they are first used."""

import ast
import importlib
from collections.abc import Callable
from pathlib import Path
from typing import Any


def late(module: str, file: str) -> tuple[dict[str, str], Callable[[str], Any]]:
    """Read what a module's file imports `if TYPE_CHECKING`: the home of each name, and the module's `__getattr__`."""
    blocks = (node for node in ast.parse(Path(file).read_text(encoding="utf-8")).body if isinstance(node, ast.If))
    imports = (node for block in blocks for node in block.body if isinstance(node, ast.ImportFrom))
    homes = {alias.name: str(node.module) for node in imports for alias in node.names}

    def find(name: str) -> Any:
        if name not in homes:
            raise AttributeError(f"module {module!r} has no attribute {name!r}")
        return getattr(importlib.import_module(homes[name]), name)

    return homes, find
