"""Texts from outside, such as names of files, in pictures and pages: as they are, and never as something else."""

import io
import re
import unicodedata
from dataclasses import replace
from html.parser import HTMLParser

import matplotlib as mpl
import numpy as np
import pytest
from _diagnosis import diagnosis, run_view

from fits import Record
from fits.io._printable import printable
from fits.io._record import Reference
from fits.plots._style import figure, verbatim
from fits.report._diagnosis import report_html

NAMES = ["a$x^$.csv", r"\$5.csv", "$$", "a$b.csv", "<b>&.csv", "50 %_{x}.csv", r"C:\alpha$\frac$", "Messung µ.csv"]


class Words(HTMLParser):
    """The words of a page."""

    def __init__(self, page):
        super().__init__()
        self.found = []
        self.feed(page)

    def handle_data(self, data):
        self.found.append(data)


def drawn(text):
    picture = figure(4, 3)
    axes = picture.subplots()
    axes.set_title(text, loc="left")
    axes.set_yscale("log")  # whose labels are formulas, and stay so
    out = io.StringIO()
    with mpl.rc_context({"svg.fonttype": "none"}):
        picture.savefig(out, format="svg")
    return " ".join(Words(out.getvalue()).found)


@pytest.mark.parametrize("name", NAMES)
def test_a_name_is_drawn_as_it_is(name):
    assert name in drawn(verbatim(name))


def test_a_long_name_keeps_its_end():
    name = "x" * 300 + "$day$1.csv"
    assert re.search(r"…x{20,50}\$day\$1\.csv", drawn(verbatim(name)))


def test_a_page_shows_names_as_they_are(rng):
    name = r"a$x^$\$<b>&.csv"
    found = diagnosis(rng)
    shown = replace(found, runs=(run_view(rng, name, 400), *found.runs[1:]))
    page = report_html(shown)
    page.encode()
    assert any(name in words for words in Words(page).found)


def test_what_cannot_be_printed_is_written_as_codes(rng):
    text = "".join(map(chr, rng.integers(0, 0x11000, 5000)))
    found = printable(text)
    found.encode()
    assert not any(unicodedata.category(c) in ("Cc", "Cf", "Cs", "Co", "Cn", "Zl", "Zp") for c in found)
    # Nothing is lost: the codes give the text back.
    kept = "".join(c for c in text if c != "\\")
    assert re.sub(r"\\(?:x..|u....|U.{8}|[nrt])", lambda code: code[0].encode().decode("unicode_escape"),
                  printable(kept)) == kept  # fmt: skip
    assert printable("Messung µ 1.csv") == "Messung µ 1.csv"


def test_records_can_be_told_of():
    x, told = np.arange(3.0), {"source": "a\udcff\n.csv", "warnings": ["a\x1b[0m: odd."]}
    for record in (Record(x, x, x, **told), Reference(x, x, **told)):
        assert (record.source, record.warnings) == (r"a\udcff\n.csv", (r"a\x1b[0m: odd.",))
