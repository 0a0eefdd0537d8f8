"""README and docs: short, linked, of commands and options that exist, and every block runs by paste."""

import os
import re
import subprocess
import sys
import tomllib

import pytest
from _command import run
from _docs import PAGES, REFERENCE, ROOT, blocks, commands, options_of, prose, reference_page

NAMES = [page.relative_to(ROOT).as_posix() for page in PAGES]
KNOWN = {name: {spelt for each in options_of(command) for spelt in each.opts} for name, command in commands()}
EVERY = set().union(*KNOWN.values(), {"--help", "--version"})


def test_the_readme_is_short_and_tells_the_two_jobs_of_ci():
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert len(text.split()) <= 900
    for mark in ("main", "test"):
        assert text.count(f"<!-- ci: {mark} -->\n```bash\npython3 -m venv .venv && ") == 1


def test_what_the_readme_found_stands_on_the_page_of_figures():
    """Two of its rows were of earlier code, and other than those of the page."""
    readme, figures = ((ROOT / name).read_text(encoding="utf-8") for name in ("README.md", "docs/figures.md"))
    table = re.search(r"\| what \| found \|\n(.*?)\n\n", readme, re.DOTALL)[1]
    said = re.findall(r"\d+\.\d+|\d+ of \d+|\b\d{3}\b", table)
    assert len(said) > 10
    assert [one for one in said if not re.search(rf"(?<![\d.]){re.escape(one)}(?!\.?\d)", figures)] == []


def test_the_citation_is_of_this_version_and_of_the_paper_of_the_readme():
    said, readme = ((ROOT / name).read_text(encoding="utf-8") for name in ("CITATION.cff", "README.md"))
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert f"\nversion: {project['version']}\n" in said
    assert f"\nlicense: {project['license']}\n" in said
    for words in re.findall(r"(?:title|family-names|doi): \"?([^\"}\n]+)", said):
        assert words in " ".join(readme.replace(">", " ").split())


def test_the_reference_is_what_the_commands_declare():
    assert REFERENCE.read_text(encoding="utf-8") == reference_page(), "run: python tests/_docs.py"


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)\s]+)\)", prose(page)):
        if "://" not in target:
            file, _, anchor = target.partition("#")
            place = (page.parent / file).resolve() if file else page
            assert place.exists(), target
            heads = re.findall(r"^#+ (.*)$", place.read_text(encoding="utf-8"), re.MULTILINE) if anchor else []
            slugs = [re.sub(r"[^\w -]", "", head.lower()).replace(" ", "-") for head in heads]
            assert not anchor or anchor in slugs, target


def test_every_page_is_linked():
    linked = {target for page in PAGES for target in re.findall(r"\]\((?:docs/)?(\w+\.md)\)", prose(page))}
    assert {page.name for page in PAGES} - {"README.md", "index.md"} <= linked


def commands_in(text):
    """Words of each call of microid in lines of a shell."""
    for line in re.split(r"\n|&&|[|;>]", text):
        words = line.split()
        if words[:1] == ["microid"]:
            yield words[1:]


@pytest.mark.parametrize("page", [page for page in PAGES if page != REFERENCE], ids=lambda page: page.name)
def test_commands_and_options_exist(page):
    spans = re.findall(r"`([^`\n]+)`", prose(page))
    shells = [text for language, text in blocks(page) if language == "bash"]
    for words in [words for text in [*shells, *spans] for words in commands_in(text)]:
        if words and not words[0].startswith("--"):
            name = " ".join(words[:2]) if " ".join(words[:2]) in KNOWN else words[0]
            assert name in KNOWN, words
            # `microid sweep SWEEP.toml` is short for `microid sweep run SWEEP.toml`.
            known = KNOWN[name] | (KNOWN["sweep run"] if name == "sweep" else set())
            assert {word for word in words if word.startswith("--")} <= known, words
    for span in spans:
        if not re.match(r"(pip|pytest|python|benchmarks|CI_FULL|MICROID)", span):
            assert set(re.findall(r"(?<![\w-])--[a-z][a-z-]*", span)) <= EVERY, span


def paste(block):
    """What of a block of a shell is run here: all but the installation."""
    return re.sub(r"python3 -m venv .*?pip install [^&]*", "true", block)


RUNNABLE = [page for page in PAGES if any(language in ("bash", "python") for language, _ in blocks(page))]


@pytest.mark.study
@pytest.mark.parametrize("page", RUNNABLE, ids=lambda page: page.name)
def test_blocks_run_by_paste(page, tmp_path):
    """In an empty folder, in their order; blocks of Python share their names, as they do in one session."""
    (tmp_path / "bin").mkdir()
    command = tmp_path / "bin" / "microid"
    command.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m fits "$@"\n')
    command.chmod(0o755)
    script = ["import subprocess"]
    for language, text in blocks(page):
        if language == "bash" and "pytest" not in text:
            script.append(f"subprocess.run(['bash', '-euo', 'pipefail', '-c', {paste(text)!r}], check=True)")
        elif language == "python":
            script.append(text)
    (tmp_path / "page.py").write_text("\n".join(script))
    path = f"{command.parent}{os.pathsep}{os.environ['PATH']}"
    done = subprocess.run(
        [sys.executable, "page.py"],
        cwd=tmp_path,
        env=os.environ | {"PATH": path, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, f"{done.stdout[-2000:]}\n{done.stderr[-3000:]}"


def test_what_a_command_is_for_is_not_cut_and_the_shell_completes_its_name():
    told = " ".join(run("--help").stdout.split())
    assert "..." not in told.partition("Commands:")[2]
    for name, command in commands():
        if " " in name:
            continue
        assert f"{name} {' '.join(command.help.split(chr(10) * 2)[0].split())}" in told
    asked = {"COMP_WORDS": "microid comp", "COMP_CWORD": "1", "_MICROID_COMPLETE": "bash_complete"}
    done = subprocess.run(
        [sys.executable, "-m", "microid"], env=os.environ | asked, capture_output=True, text=True, check=False
    )
    assert done.stdout.split() == ["plain,compensate"]
