"""The report of a diagnosis as a browser shows and prints it."""

import math
import re
from dataclasses import replace

import pytest
from _browser import browser, opened, printed
from _diagnosis import KINDS, diagnosis
from PIL import Image

from fits import ParameterEstimate
from fits.report._diagnosis import report_html
from fits.report._page import write_page

pytestmark = pytest.mark.skipif(browser() is None, reason="there is no Chromium to open the report with")
# A sheet of A4 less its margins, in CSS pixels of 1/96 in.
MARGIN_mm, A4_mm = 16, (210, 297)
SHEET_px = [math.floor((side - 2 * MARGIN_mm) / 25.4 * 96) for side in A4_mm]


@pytest.mark.parametrize("width_px", [390, 1200])
def test_a_browser_shows_the_report_without_scrolling_sideways(rng, tmp_path, width_px):
    made = diagnosis(rng, "unexplained")
    # As a fit gives them: the units of such long ones were beyond the edge of their table.
    given = {"value": 0.00060133, "sd": 2.9e-6, "lower": 0.00059567, "upper": 0.00060702}
    long = ParameterEstimate("driver.time_constant_s", "s", **given)
    rare = ParameterEstimate("driver.least_s", "s", **{key: -1.2345e-9 * x for key, x in given.items()})
    page = report_html(replace(made, baseline_parameters=(long, rare), extended_parameters=(long, rare)))
    seen = opened(page, width_px, tmp_path)
    assert seen["sideways"] == []
    assert "driver time constant (s)" in page
    assert seen["width"] == width_px
    assert seen["needed"] <= width_px
    assert seen["problems"] == []
    assert seen["broken"] == 0
    visible = [width for width in seen["pictures"] if width > 0]
    assert len(visible) == len(seen["pictures"]) / 2
    assert all(250 < width <= width_px for width in visible)
    wide = page.replace("<main>", '<main><div style="width: 3000px">x</div>', 1)
    assert opened(wide, width_px, tmp_path)["needed"] > width_px


# Drags over the first panel from 40 to 60 % of its width, and says where its curve, ticks and hint are then.
DRAG = """(() => {
    const svg = d.querySelector(".wide svg[data-spans]"), pad = svg.querySelector("rect.zoom");
    const box = pad.getBoundingClientRect(), curve = svg.querySelector("[id$=zoom0-0]");
    const at = share => ({clientX: box.left + share * box.width, clientY: box.top + 5, bubbles: true});
    const send = (name, share) => pad.dispatchEvent(new w.MouseEvent(name, at(share)));
    const told = () => ({width: curve.getBoundingClientRect().width / box.width, texts:
        [...svg.querySelectorAll("[id$=ticks0] > g")].filter(g => g.style.display !== "none")
        .filter(g => g.querySelector("use")).map(g => g.querySelector("text").textContent)});
    const before = told();
    send("pointerdown", 0.4); send("pointermove", 0.6); send("pointerup", 0.6);
    const zoomed = told();
    send("dblclick", 0.5);
    return {before, zoomed, after: told(), hint: !svg.closest("figure").querySelector(".hint").hidden};
})()"""


def test_a_stretch_of_a_trace_is_enlarged_where_it_is_dragged_over(rng, tmp_path):
    seen = opened(report_html(diagnosis(rng, n=2000, count=1)), 1200, tmp_path, DRAG)
    acted, (before, zoomed) = seen["acted"], (seen["acted"][name]["texts"] for name in ("before", "zoomed"))
    assert seen["problems"] == []
    assert acted["hint"]
    assert acted["after"] == acted["before"]
    assert acted["zoomed"]["width"] == pytest.approx(5 * acted["before"]["width"], rel=0.01)
    # The run takes 19.99 s, so that these are those from 8 s to just short of 12 s.
    assert (float(before[0]), float(before[-1])) == (0.0, 17.5)
    assert sorted(map(float, zoomed)) == [8.0, 9.0, 10.0, 11.0]


# Height of the page; ends of what holds text beyond its right edge; and texts that are there and are not drawn.
LAID_OUT = """(() => {
    const right = d.documentElement.clientWidth, all = [...d.querySelectorAll("main *")];
    const box = one => one.getBoundingClientRect();
    const hidden = one => one.closest(".narrow, .hint, script, style, svg") !== null
        || w.getComputedStyle(one).display === "contents";
    return {height: d.documentElement.scrollHeight,
        beyond: all.filter(one => !one.closest("svg") && box(one).right > right + 0.5).map(one => one.outerHTML),
        unseen: all.filter(one => one.textContent.trim() && !hidden(one) && !(box(one).width * box(one).height > 0))
            .map(one => one.outerHTML)};
})()"""


@pytest.mark.parametrize("kind", [*(pytest.param(kind, marks=pytest.mark.study) for kind in KINDS[:2]), KINDS[2]])
def test_the_report_prints_on_a4_and_nothing_is_cut(rng, tmp_path, kind):
    page = report_html(diagnosis(rng, kind))
    # What is only for paper, in a frame as wide as the sheet.
    assert page.count("@media print") == 2
    seen = opened(page.replace("@media print", "@media all"), SHEET_px[0], tmp_path, LAID_OUT)
    assert seen["needed"] <= SHEET_px[0]
    assert seen["acted"]["beyond"] == seen["acted"]["unseen"] == []
    pdf = printed(page, tmp_path)
    boxes = [list(map(float, box.split())) for box in re.findall(rb"/MediaBox \[([^]]*)\]", pdf)]
    sheets = len(re.findall(rb"/Type /Page\b", pdf))
    assert len(boxes) == sheets
    for box in boxes:
        assert box == pytest.approx([0, 0, *(side / 25.4 * 72 for side in A4_mm)], abs=1)
    # Not scaled down to fit, and little room is left before what must not be cut in two.
    sheets_needed = seen["acted"]["height"] / SHEET_px[1]
    assert sheets_needed <= sheets <= 1 + 1.3 * sheets_needed
    wide = page.replace("<main>", '<main><div style="width: 3000px">x</div>', 1).replace("@media print", "@media all")
    assert opened(wide, SHEET_px[0], tmp_path, LAID_OUT)["acted"]["beyond"]


WORDS = """FAR FROM NOISE 1.745 um rms in fast.csv, 4.35 % of its stroke and 58.3 times the sensor's noise (29.9 nm)\
: all below is no better
                samples      e_rms                   e_max
in-sample         25682    3.309 %     1.328 um    14.88 %     5.972 um
mechanics.natural_frequency_Hz  179.9950 ± 0.0024     (95 % 179.9902..179.9998)      Hz
e_rms: root mean square error, e_max: largest error, both in % of the measured range (Eq. 35, 36)"""
# Ends of what holds text beyond the edge of its box, and how wide each picture is.
WORDS_LAID = """(() => ({
    cut: [...d.querySelectorAll(".words span")].filter(one => one.scrollWidth > one.closest("pre").clientWidth)
        .map(one => one.className),
    lines: [...d.querySelectorAll(".words span")].map(one => one.getBoundingClientRect().height),
    images: [...d.images].map(one => one.getBoundingClientRect().width)}))()"""


@pytest.mark.parametrize("width_px", [390, 1200])
def test_words_of_a_page_are_not_cut_and_pictures_have_their_size(tmp_path, width_px):
    for name, wide_px in (("narrow", 708), ("wide", 1418)):
        Image.new("RGB", (wide_px, 100)).save(tmp_path / f"{name}.png")
    write_page(tmp_path, "Fit of train.csv", WORDS, [tmp_path / "narrow.png", tmp_path / "wide.png"])
    page = (tmp_path / "index.html").read_text().replace("<head>", f'<head><base href="{tmp_path.as_uri()}/">')
    seen = opened(page, width_px, tmp_path, WORDS_LAID)
    assert (seen["problems"], seen["broken"]) == ([], 0)
    assert seen["needed"] <= width_px
    # A phone shows a table by moving it sideways, and no sentence so.
    acted = seen["acted"]
    assert "line" not in acted["cut"]
    assert ("row" in acted["cut"]) == (width_px < 500)
    sentence, head, row, *_ = acted["lines"]
    assert sentence > head == row
    narrow_px, wide_px = acted["images"]
    assert narrow_px == pytest.approx(708 * 96 / 200, abs=1)
    assert wide_px == pytest.approx(480 if width_px < 500 else 1418 * 96 / 200, abs=1)
