"""The page of a folder, asked for as a browser asks, and opened in one where there is one."""

import base64
import functools
import json
import re
import shutil
import socket
import struct
import threading
import time
import urllib.error
import urllib.request
from xml.etree import ElementTree

import numpy as np
import pytest
from _browser import browser, opened
from _command import refused, run
from _diagnosis import diagnosis
from _seed import seed_of
from _sweeps import parsed, small
from test_diagnosis_report import Page

from fits import default_stage, save_model
from fits.cli.serve import _Pages, _Server
from fits.report._diagnosis import report_html
from fits.sweeps._run import run_sweep
from fits.sweeps._show import open_sweep, summarise
from fits.sweeps._store import ABOUT, LEDGER

ROWS = 12


@pytest.fixture(scope="module")
def folder_and_address(tmp_path_factory):
    """A folder of results, and its address on a free port."""
    folder = tmp_path_factory.mktemp("results")
    report = report_html(diagnosis(np.random.default_rng(seed_of("test_serve")), count=1))
    for name in ("first", "se & cond"):
        (folder / name).mkdir(parents=True)
        (folder / name / "report.html").write_text(report, encoding="utf-8")
        (folder / name / "diagnosis.json").write_text("{}")
    save_model(folder / "stage.json", default_stage(), None, {})
    shutil.copy(folder / "stage.json", folder / "first" / "extended.json")
    (folder / "other.json").write_text(json.dumps({"schema": "another/1"}))
    run_sweep(parsed(small(1, ROWS)), folder / "whole")
    # A sweep that is broken says so in its place.
    (folder / "sweep" / LEDGER).mkdir(parents=True)
    (folder / "sweep" / ABOUT).write_text("{")
    server = _Server(("127.0.0.1", 0), functools.partial(_Pages, directory=str(folder)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield folder, f"http://127.0.0.1:{server.server_port}/"
    server.shutdown()
    server.server_close()


@pytest.fixture(scope="module")
def address(folder_and_address):
    return folder_and_address[1]


@pytest.fixture(scope="module")
def swept(folder_and_address):
    """The folder of a sweep that is whole."""
    return folder_and_address[0] / "whole"


def asked(address):
    with urllib.request.urlopen(address) as answer:
        return answer.read().decode()


def status_of(address, **headers):
    try:
        with urllib.request.urlopen(urllib.request.Request(address, headers=headers)) as answer:
            return answer.status
    except urllib.error.HTTPError as refusal:
        return refusal.code


def test_results_stand_side_by_side_for_this_machine_alone(address):
    text = asked(address)
    page = Page(text)
    assert text.count("<iframe") == 2
    assert text.count("<article") == 5
    # A model by itself is shown, and that of a diagnosis by its report.
    for words in ("stage.json", "natural_frequency_Hz", "first/report.html", "se & cond/report.html", ABOUT):
        assert words in page.text
    assert "extended.json" not in page.text
    assert [status_of(address + link) for link in page.links if not link.startswith("data:")] == [200] * 7
    # Each opens by its name, says when it was written, and words, whose lines are long, have the whole width.
    for name, place in (("Model stage.json", "stage.json.html"), ("Sweep sweep", "sweep/about.json.html")):
        assert f'<h2><a href="{place}">{name}</a></h2>' in text
    assert len(re.findall(r"· \d{4}-\d\d-\d\d \d\d:\d\d</p>", text)) == 5
    assert text.count('<article class="whole">') == text.count('<pre class="words">') == 3
    assert re.search(r"\.gallery \.whole \{ grid-column: 1 / -1", text)
    assert status_of(address, Host="rebound.example:80") == 404
    for inside in ("first/", "sweep/ledger", "../secret", "%2e%2e/secret"):
        assert status_of(address + inside) == 404


def test_a_model_and_a_sweep_open_as_pages_and_not_as_json(address, swept):
    """A sweep that is whole has its figures, its pictures and its text; what is broken says so."""
    page, model, broken = (
        asked(address + f"{name}.html") for name in ("whole/about.json", "stage.json", "sweep/about.json")
    )
    figures = summarise(swept)["outputs"]["stroke_um"]
    assert re.search(rf"stroke_um +{figures['min']:.4g} ", Page(page).text)
    for words in ("<h1>Sweep whole</h1>", "kind = &#34;simulate&#34;", f" of {ROWS} rows done"):
        assert words in page
    # Why rows failed is told once for all of them, without the value of each.
    reasons = [str(one) for one in open_sweep(swept)["reason"].values if str(one)]
    assert reasons
    assert all(re.fullmatch(r"mechanics\.damping_ratio = -\S+ lies outside .*", one) for one in reasons)
    assert f"{len(reasons)} rows: mechanics.damping_ratio lies outside its bounds, 0 to inf" in Page(page).text
    drawn = [base64.b64decode(one).decode() for one in re.findall(r'src="data:image/svg\+xml;base64,([^"]+)"', page)]
    # Parallel coordinates, and one map for the only pair of parameters.
    assert len(drawn) == 2
    assert all(ElementTree.fromstring(one).tag.endswith("svg") for one in drawn)
    # Cells have edges of their own colour, so that no white lines are between them.
    cells = re.search(r'<g id="QuadMesh_1">(.*?)</g>', drawn[1], re.DOTALL)[1]
    colours = re.findall(r"fill: (#\w+)(?:; stroke: (#\w+))?", cells)
    assert len(colours) > 5
    assert all(inside == edge for inside, edge in colours)
    assert "natural_frequency_Hz" in Page(model).text
    assert "<h1>Model stage.json</h1>" in model
    assert "about.json is broken" in Page(broken).text
    assert "<img" not in broken
    # No other file has such a page, and nothing was written for these.
    for other in ("other.json", "none.json", "whole/sweep.toml", "first/report"):
        assert status_of(f"{address}{other}.html") == (200 if other == "first/report" else 404)
    assert not list(swept.parent.rglob("*.json.html"))


def test_a_browser_that_hangs_up_is_not_told_of(tmp_path, capsys):
    (tmp_path / "large").write_bytes(bytes(50_000_000))
    server = _Server(("127.0.0.1", 0), functools.partial(_Pages, directory=str(tmp_path)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    with socket.create_connection(server.server_address) as asking:
        asking.sendall(b"GET /large HTTP/1.1\r\nHost: localhost:1\r\n\r\n")
        assert asking.recv(1) == b"H"
        # Closed so, the connection is reset, with the rest of the answer on its way.
        asking.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    while any("process_request_thread" in one.name for one in threading.enumerate()):
        time.sleep(0.01)
    server.shutdown()
    server.server_close()
    assert capsys.readouterr().err == ""


def test_what_cannot_be_served_is_said(address, tmp_path):
    refused(run("serve", tmp_path / "none"), "none")
    taken = address.rpartition(":")[2].strip("/")
    refused(run("serve", tmp_path, "--port", taken), "--port", taken)


@pytest.mark.skipif(browser() is None, reason="there is no Chromium to open the page with")
@pytest.mark.parametrize("width_px", [390, 1200])
def test_a_browser_shows_results_side_by_side_where_there_is_room(address, tmp_path, width_px):
    for inner in ("whole/about.json.html", "stage.json.html", ""):
        text = asked(address + inner).replace("<head>", f'<head><base href="{address}">')
        seen = opened(text, width_px, tmp_path)
        assert (seen["problems"], seen["broken"]) == ([], 0)
        assert seen["needed"] <= width_px
    lefts = {round(left) for left in seen["lefts"]}
    assert len(lefts) == (1 if width_px < 500 else 2)
