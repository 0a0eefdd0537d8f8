"""Which microid this is."""

from importlib.metadata import PackageNotFoundError, version


def written_by() -> str:
    """Name and version, such as `microid 0.1.0`."""
    try:
        return f"microid {version('microid')}"
    except PackageNotFoundError:
        return "microid, not installed"
