"""What a command says and draws as one page, beside its pictures."""

import re
from collections.abc import Iterable
from importlib.resources import files
from pathlib import Path

from jinja2 import Environment, PackageLoader, StrictUndefined

from fits.io._printable import printable
from fits.io._version import written_by
from fits.plots._style import DOTS_PER_in

# Letters at most by which a line that goes on is set in.
_MOST_INDENT = 16
# A number and what it counts, and a power of ten with what is before it, in text and outside of commands.
_UNIT = "(?<=\\d) (?=(?:%|[pnµum]?m|k?Hz|m?s|k?V|\N{GREEK SMALL LETTER SIGMA})(?![\\w/]))"
_POWER = "(?<=\\d) (?=\N{MULTIPLICATION SIGN} 10)|(?<=\\d \N{MULTIPLICATION SIGN}) (?=10)|(?<=below) (?=10)"
_QUANTITY = re.compile(f"{_UNIT}|{_POWER}")


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
    made.filters["laid_out"] = laid_out
    return made


def laid_out(words: str) -> list[tuple[str, str, int]]:
    """Lines of a terminal, the class of each, and how many letters what goes on in a further line is set in.

    What stands in columns, with several gaps, is a `row`, and kept whole; a sentence behind its name is a `line`.
    """
    lines = []
    for line in words.splitlines():
        gaps = [gap.end() for gap in re.finditer(r"(?<=\S) {2,}(?=\S)", line)]
        indent = gaps[0] if len(gaps) == 1 else len(line) - len(line.lstrip()) + 2
        lines.append((line, "row" if len(gaps) > 1 else "line", min(indent, _MOST_INDENT)))
    return lines


def unbroken(page: str) -> str:
    """Keep numbers and their units on one line, but for what stands in `pre`, which is pasted."""
    parts = re.split(r"(<pre.*?</pre>)", page, flags=re.DOTALL)
    return "".join(part if part.startswith("<pre") else _QUANTITY.sub("\N{NO-BREAK SPACE}", part) for part in parts)


def _width_px(picture: Path) -> float | None:
    """How wide a PNG was drawn, in CSS pixels of 1/96 in; None for other formats, which say it themselves."""
    if picture.suffix != ".png":
        return None
    with picture.open("rb") as file:
        # The first chunk, behind its length, has the width and the height.
        return int.from_bytes(file.read(20)[16:20], "big") * 96 / DOTS_PER_in


def page_html(title: str, words: str, pictures: Iterable[tuple[str, str, float | None]], sweep: str = "") -> str:
    """Write a page: a title, words as a terminal shows them, pictures, and the text of a sweep, which may be opened.

    Of each picture the name, the address and the width in CSS pixels are given; None for one that says it itself.
    """
    shown = {"title": printable(title), "words": words, "pictures": list(pictures), "sweep": sweep}
    return environment().get_template("page.html").render(shown)


def write_page(folder: Path, title: str, words: str, pictures: Iterable[Path]) -> None:
    """Write `index.html` into the folder of some pictures: a title, words as a terminal shows them, the pictures."""
    drawn = [(picture.name, picture.name, _width_px(picture)) for picture in pictures]
    (folder / "index.html").write_text(page_html(title, words, drawn), encoding="utf-8")
