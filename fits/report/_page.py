"""What a command says and draws as one page, beside its pictures."""

from collections.abc import Iterable
from importlib.resources import files
from pathlib import Path

from jinja2 import Environment, PackageLoader, StrictUndefined

from fits.io._printable import printable
from fits.io._version import written_by


def environment() -> Environment:
    """Templates of this room, which escape whatever they are given."""
    loader = PackageLoader("fits.report")
    made = Environment(
        loader=loader,
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    for name, file in (("style", "report.css"), ("zoom", "zoom.js")):
        made.globals[name] = files("fits.report").joinpath(file).read_text(encoding="utf-8")
    made.globals["written_by"] = written_by()
    return made


def write_page(folder: Path, title: str, words: str, pictures: Iterable[Path]) -> None:
    """Write `index.html` into the folder of some pictures: a title, words as a terminal shows them, the pictures."""
    shown = {"title": printable(title), "words": words, "pictures": [picture.name for picture in pictures]}
    (folder / "index.html").write_text(environment().get_template("page.html").render(shown), encoding="utf-8")
