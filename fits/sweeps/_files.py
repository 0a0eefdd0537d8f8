"""Contents of files that travel with a sweep."""

import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from fits.io._errors import DataError


def in_a_file(content: bytes, name: str, read: Callable[[Path], Any]) -> Any:
    """Read a content with what reads files; sentences name the file as the sweep does."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / os.path.basename(name)
        path.write_bytes(content)
        try:
            return read(path)
        except DataError as error:
            raise DataError(str(error).replace(str(path), name)) from None
