"""What a command says and draws as one page, beside its pictures."""

import re
from collections.abc import Iterable
from importlib.resources import files
from pathlib import Path

from jinja2 import Environment, PackageLoader, StrictUndefined

from fits.io._printable import printable
from fits.io._version import written_by

# A number and what it counts, in text and outside of commands.
_QUANTITY = re.compile("(?<=\\d) (?=(?:%|[pnµum]?m|k?Hz|m?s|k?V|\N{GREEK SMALL LETTER SIGMA})(?![\\w/]))")


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


def unbroken(page: str) -> str:
    """Keep numbers and their units on one line, but for what stands in `pre`, which is pasted."""
    parts = re.split(r"(<pre.*?</pre>)", page, flags=re.DOTALL)
    return "".join(part if part.startswith("<pre") else _QUANTITY.sub("\N{NO-BREAK SPACE}", part) for part in parts)


def write_page(folder: Path, title: str, words: str, pictures: Iterable[Path]) -> None:
    """Write `index.html` into the folder of some pictures: a title, words as a terminal shows them, the pictures."""
    shown = {"title": printable(title), "words": words, "pictures": [picture.name for picture in pictures]}
    (folder / "index.html").write_text(environment().get_template("page.html").render(shown), encoding="utf-8")
