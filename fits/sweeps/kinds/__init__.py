"""The kinds of sweeps, one file each, named after what it adds.

A file has `KEYS`, the keys of a sweep's TOML that are its own, and `make`, which makes the job of a `Request`; a TOML
of the same name beside it is the example that `microid sweep --example` prints.
"""

import importlib
import pkgutil
from pathlib import Path
from typing import Any


def names() -> list[str]:
    """All kinds; none of them is imported for that."""
    return sorted(found.name for found in pkgutil.iter_modules(__path__))


def kind(name: str) -> Any:
    """The module of a kind."""
    return importlib.import_module(f"{__name__}.{name}")


def examples() -> dict[str, Path]:
    """Files of examples that run as they are, by their kinds."""
    files = {name: Path(__path__[0]) / f"{name}.toml" for name in names()}
    return {name: file for name, file in files.items() if file.exists()}
