"""What a folder holds of diagnoses, fits and sweeps, side by side on one page."""

import html
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from urllib.parse import quote

from fits.io._errors import DataError
from fits.io._model_text import read_model_text
from fits.report._model_words import model_words
from fits.report._page import environment
from fits.sweeps._show import describe_sweep, summarise
from fits.sweeps._store import ABOUT, LEDGER

# What stands for nothing by itself beside a diagnosis.
_OF_DIAGNOSIS = {"baseline.json", "extended.json"}
# How model files begin, and how much of a file is looked at.
_MODEL, _START = '"microid.model/', 100_000
_TITLE = re.compile(r"<title>(.*?)</title>", re.DOTALL)


@dataclass(frozen=True)
class Shown:
    """A page or a result without one: its title, where it is, its address below the folder, when it was written.

    A result without a page has its words.
    """

    title: str
    place: str
    page: str
    when: str
    words: str = ""


def gallery_html(folder: Path) -> str:
    """Write a page that shows side by side what a folder and those in it hold."""
    return environment().get_template("gallery.html").render(folder=folder.resolve().name, shown=list(_found(folder)))


def _found(folder: Path) -> Iterator[Shown]:
    for at, inner, names in os.walk(folder):
        here, within = Path(at), Path(at).relative_to(folder)
        inner[:] = sorted(name for name in inner if name != LEDGER and not name.endswith(".zarr") and name[0] != ".")
        if ABOUT in names and LEDGER in os.listdir(here):
            yield Shown(
                f"Sweep {here.resolve().name}",
                str(within),
                _address(within / ABOUT),
                _when(here / ABOUT),
                _words(here),
            )
        for name in sorted(names):
            path, place, start = here / name, str(within / name), ""
            if name.endswith((".html", ".json")):
                start = path.read_text(encoding="utf-8", errors="replace")[:_START]
            if name.endswith(".html"):
                title = _TITLE.search(start)
                words = html.unescape(title[1]) if title else name
                yield Shown(words, place, _address(within / name), _when(path))
            elif _MODEL in start[:200] and not (name in _OF_DIAGNOSIS and "diagnosis.json" in names):
                yield Shown(f"Model {name}", place, _address(within / name), _when(path), _words(path))


def _address(place: Path) -> str:
    return quote(place.as_posix())


def _when(path: Path) -> str:
    """When a file was written last, in local time."""
    return f"{datetime.fromtimestamp(path.stat().st_mtime):%Y-%m-%d %H:%M}"


def _words(path: Path) -> str:
    try:
        if path.is_dir():
            return describe_sweep(summarise(path))
        return model_words(str(path), read_model_text(str(path)))
    except DataError as error:
        return str(error)
