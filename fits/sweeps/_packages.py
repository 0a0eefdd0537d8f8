"""Packages that only sweeps need, and the versions that results depend on."""

import hashlib
import platform
from functools import lru_cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from fits.io import _late


def need(name: str) -> Any:
    """Import a package of the extras `sweep` and `cluster`; a `DataError` says what to run if it is not installed."""
    return _late.need(name, "sweep,cluster" if name.partition(".")[0] == "distributed" else "sweep")


@lru_cache(maxsize=1)
def versions() -> dict[str, str]:
    """Version of Python and of each package that computes."""
    found = {"python": platform.python_version()}
    for name in ("microid", "jax", "jaxlib", "equinox", "optimistix", "numpy", "scipy"):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = _checkout() if name == "microid" else "not installed"
    return found


def _checkout() -> str:
    """What tells a checkout that is not installed from others: a sum of its sources."""
    total, root = hashlib.sha256(), Path(__file__).parents[2]
    for path in sorted(path for package in ("fits", "microid") for path in (root / package).rglob("*.py")):
        total.update(path.relative_to(root).as_posix().encode() + path.read_bytes())
    return f"checkout {total.hexdigest()[:12]}"
