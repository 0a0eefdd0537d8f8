"""What a format of files is, and how the right one is found."""

from collections.abc import Callable
from dataclasses import dataclass

from fits.io._table import Table


@dataclass(frozen=True)
class Format:
    """A kind of file that holds columns. To add one, put one file that registers it into this folder.

    `name` is as in "expected a CSV file". A file is of this format if it begins with one of `starts` or, where no
    format is found so, if its name ends in one of `endings`. `open` makes a table of its name, which may end in the
    number of one of several where the format has those, and its bytes.
    """

    name: str
    endings: tuple[str, ...]
    starts: tuple[bytes, ...]
    open: Callable[[str, bytes], Table]
    several: bool = False


# By name, in the order of the files.
FORMATS: dict[str, Format] = {}


def register(form: Format) -> None:
    """Make a format known."""
    FORMATS[form.name] = form
