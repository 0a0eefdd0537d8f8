"""What a folder holds of diagnoses, fits and sweeps, side by side on one page."""

import base64
import html
import os
import re
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from urllib.parse import quote

from fits.io._errors import DataError
from fits.io._model_text import read_model_text
from fits.plots._sweep import plot_sweep
from fits.report._model_words import model_words
from fits.report._page import environment, page_html
from fits.sweeps._show import describe_sweep, summarise
from fits.sweeps._store import ABOUT, LEDGER, about_of

# What stands for nothing by itself beside a diagnosis.
_OF_DIAGNOSIS = {"baseline.json", "extended.json"}
# What is added to the name of a file for the page of a result that has none of its own.
PAGE = ".html"
# How model files begin, and how much of a file is looked at.
_MODEL, _START = '"microid.model/', 100_000
_TITLE = re.compile(r"<title>(.*?)</title>", re.DOTALL)


@dataclass(frozen=True)
class Shown:
    """A page or a result without one: its title, where it is, its address below the folder, when it was written.

    A result without a page of its own has its words.
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
                _sweep_title(here),
                str(within),
                _address(within / ABOUT) + PAGE,
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
                yield Shown(f"Model {name}", place, _address(within / name) + PAGE, _when(path), _words(path))


def result_html(path: Path) -> str | None:
    """Write the page of a result that has none of its own: of a model file, or of the sweep that a file is about.

    None for any other file. A sweep is shown with its pictures and the text that it was made from.
    """
    if path.name == ABOUT and (path.parent / LEDGER).is_dir():
        folder = path.parent
        try:
            text, pictures = str(about_of(folder).get("sweep", "")), _pictures(folder)
        except DataError:
            # What is broken is said in its words.
            text, pictures = "", []
        return page_html(_sweep_title(folder), _words(folder), pictures, text)
    if path.suffix == ".json" and path.is_file():
        with path.open(encoding="utf-8", errors="replace") as file:
            is_model = _MODEL in file.read(200)
        return page_html(f"Model {path.name}", _words(path), []) if is_model else None
    return None


def _pictures(folder: Path) -> list[tuple[str, str, None]]:
    """Pictures of a sweep, in their addresses."""
    with tempfile.TemporaryDirectory() as place:
        drawn = plot_sweep(folder, place, form="svg")
        texts = [(one.stem, base64.b64encode(one.read_bytes()).decode("ascii")) for one in drawn]
    return [(name, f"data:image/svg+xml;base64,{text}", None) for name, text in texts]


def _sweep_title(folder: Path) -> str:
    return f"Sweep {folder.resolve().name}"


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
