"""Measured records, which are kept beside the repository."""

from pathlib import Path

import pytest

_DATA = Path(__file__).parents[2] / "shared" / "data"


def measured(name: str) -> Path:
    """Where a record is; the test is skipped where it is not at hand."""
    path = _DATA / name
    if not path.exists():
        pytest.skip(f"{name} is not at hand: measured records are kept beside the repository")
    return path
