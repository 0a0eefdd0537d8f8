"""Versions that results depend on."""

import platform
from importlib.metadata import PackageNotFoundError, version

_NAMES = ("microid", "jax", "jaxlib", "equinox", "optimistix", "numpy", "scipy")


def versions() -> dict[str, str]:
    """Version of Python and of each package that computes."""
    found = {"python": platform.python_version()}
    for name in _NAMES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    return found
