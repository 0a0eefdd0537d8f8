"""Every notebook runs from its first cell to its last, and is committed without outputs."""

import os
import runpy
import warnings
from pathlib import Path
from types import SimpleNamespace

import pytest

# The kernel's tools are not ours, and some of them warn of one another on import.
with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    import nbclient
    import nbformat

ROOT = Path(__file__).parents[1]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
EXECUTED = ROOT / "build" / "notebooks"


def test_there_are_notebooks():
    assert NOTEBOOKS


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.name)
def test_notebook_is_clean(path):
    for cell in nbformat.read(path, as_version=4).cells:
        if cell.cell_type == "code":
            assert cell.outputs == [], "clear all outputs before saving"
            assert cell.execution_count is None, "clear all outputs before saving"


def test_notebooks_are_on_the_site_with_what_they_print(tmp_path):
    listed = (ROOT / "docs" / "site" / "index.md").read_text(encoding="utf-8")
    assert all(f"../../notebooks/{path.stem}\n" in listed for path in NOTEBOOKS)
    executed = runpy.run_path(str(ROOT / "docs" / "site" / "conf.py"))["executed"]
    (tmp_path / "build" / "notebooks").mkdir(parents=True)
    (tmp_path / "build" / "notebooks" / "a.ipynb").write_text("with outputs")
    for name, shown in (("notebooks/a", "with outputs"), ("notebooks/b", "plain"), ("docs/files", "plain")):
        source = ["plain"]
        executed(SimpleNamespace(srcdir=tmp_path), name, source)
        assert source == [shown]


@pytest.mark.study
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.name)
def test_notebook_runs(path, tmp_path):
    notebook = nbformat.read(path, as_version=4)
    client = nbclient.NotebookClient(
        notebook, timeout=1800, kernel_name="python3", resources={"metadata": {"path": str(tmp_path)}}
    )
    # The kernel works on this checkout even where another one is installed.
    client.execute(
        env=os.environ | {"PYTHONPATH": str(ROOT)}
    )  # raises CellExecutionError with the cell and its traceback
    assert any(cell.get("outputs") for cell in notebook.cells)
    # For the site, whose build shows it; see docs/site/conf.py.
    EXECUTED.mkdir(parents=True, exist_ok=True)
    nbformat.write(notebook, EXECUTED / path.name)
