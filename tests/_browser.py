"""Pages in a headless Chromium."""

import json
import re
import shutil
import subprocess
from html import unescape


def browser():
    names = ("chromium", "chromium-browser", "google-chrome")
    return next(filter(None, map(shutil.which, names)), None)


def opened(text, width_px, folder, act="null"):
    """What a browser says of a page in a frame of a width; a window cannot be as narrow as a phone.

    `act` is what is done there before, with the window `w` and the document `d`, and comes back as `acted`.
    """
    watch = (
        "<script>window.problems = []; addEventListener('error', e => problems.push(String(e.message)), true);"
        "console.error = (...words) => problems.push(words.join(' '));</script>"
    )
    page = json.dumps(text.replace("<head>", f"<head>{watch}", 1)).replace("</", "<\\/")
    outer = folder / f"outer{width_px}.html"
    outer.write_text(
        f"<!DOCTYPE html><body><iframe id='frame' width='{width_px}' height='800' style='border:0'></iframe>"
        "<pre id='seen'></pre><script>const frame = document.getElementById('frame');"
        "frame.addEventListener('load', () => { const w = frame.contentWindow, d = w.document;"
        f"const acted = {act};"
        "document.getElementById('seen').textContent = JSON.stringify({acted, width: w.innerWidth,"
        "needed: d.documentElement.scrollWidth, problems: w.problems,"
        "lefts: [...d.querySelectorAll('article')].map(one => one.getBoundingClientRect().left),"
        "sideways: [...d.querySelectorAll('.scroll')].filter(one => one.scrollWidth > one.clientWidth)"
        ".map(one => one.textContent),"
        "pictures: [...d.querySelectorAll('figure svg')].map(s => s.getBoundingClientRect().width),"
        "broken: [...d.images].filter(i => !i.complete || !i.naturalWidth).length}); });"
        f"frame.srcdoc = {page};</script></body>",
        encoding="utf-8",
    )
    said = _run(folder, "--virtual-time-budget=5000", "--window-size=1400,900", "--dump-dom", outer.as_uri())
    return json.loads(unescape(re.search(r'<pre id="seen">(.*?)</pre>', said, re.DOTALL)[1]))


def printed(text, folder):
    """A page as the bytes of a PDF."""
    page, out = folder / "page.html", folder / "page.pdf"
    page.write_text(text, encoding="utf-8")
    _run(folder, "--no-pdf-header-footer", f"--print-to-pdf={out}", page.as_uri())
    return out.read_bytes()


def _run(folder, *options):
    command = [browser(), "--headless=new", "--no-sandbox", "--disable-gpu", f"--user-data-dir={folder / 'profile'}"]
    return subprocess.run([*command, *options], capture_output=True, text=True, check=True, timeout=60).stdout
