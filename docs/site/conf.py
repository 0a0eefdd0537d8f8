"""The pages and notebooks as a site, by Sphinx from the root of the repository: see CONTRIBUTING.md."""

import ast
import importlib
import inspect
import itertools
import re
from pathlib import Path

project = "microid"
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.mathjax"]
include_patterns = ["*.md", "docs/**", "benchmarks/*.md", "notebooks/*.ipynb"]
root_doc = "docs/site/index"
html_theme = "furo"
html_show_copyright = False
myst_heading_anchors = 3
nb_execution_mode = "off"
napoleon_use_ivar = True
autodoc_typehints = "none"
autodoc_member_order = "bysource"
# Names in docstrings are in single backticks.
default_role = "literal"


def executed(app, name, source):
    """Show a notebook with its outputs where `pytest -m study tests/test_notebooks.py` has left an executed copy."""
    copy = Path(app.srcdir, "build", f"{name}.ipynb")
    if name.startswith("notebooks/") and copy.exists():
        source[0] = copy.read_text(encoding="utf-8")


def groups_of(module):
    """Public names of a module in the groups of its `__all__`: the heading of each, and the names."""
    text = inspect.getsource(module)
    listed = re.search(r"^__all__ = \[.*?\n(.*?)^\]", text, re.MULTILINE | re.DOTALL)[1]
    for part in re.split(r"^ *# ", listed, flags=re.MULTILINE)[1:]:
        heading, _, names = part.partition("\n")
        yield heading, re.findall(r'"(\w+)"', names)


def documented(module, name):
    """One public name, as a directive: what it is, or for a constant the words below it where it is defined."""
    value = getattr(module, name)
    if inspect.isclass(value):
        return [f".. {'autoexception' if issubclass(value, Exception) else 'autoclass'}:: {name}", "   :members:"]
    if callable(value) and inspect.isroutine(inspect.unwrap(value)):
        return [f".. autofunction:: {name}"]
    return [f".. data:: {name}", "", f"   {words_of(module, name)}"]


def words_of(module, name):
    """The string below a constant, in the file from which a package takes it; an `AssertionError` where none is."""
    for node in ast.walk(ast.parse(inspect.getsource(module))):
        if isinstance(node, ast.ImportFrom) and name in [alias.name for alias in node.names]:
            body = ast.parse(inspect.getsource(importlib.import_module(node.module))).body
            for made, below in itertools.pairwise(body):
                targets = getattr(made, "targets", [getattr(made, "target", None)])
                if any(getattr(each, "id", "") == name for each in targets):
                    assert isinstance(below, ast.Expr), f"{name} has no words below it in {node.module}"
                    return " ".join(below.value.value.split())
    raise AssertionError(f"{module.__name__} takes {name} from nowhere")


def grouped(app, name, source):
    """Add to the page of a module its public names, in groups."""
    if not name.startswith("docs/site/names/"):
        return
    module = importlib.import_module(name.rpartition("/")[2])
    lines = [source[0], "```{eval-rst}", f".. automodule:: {module.__name__}", "```"]
    for heading, names in groups_of(module):
        every = [line for each in names for line in ["", *documented(module, each)]]
        lines += ["", f"## {heading}", "", "```{eval-rst}", f".. currentmodule:: {module.__name__}", *every, "```"]
    source[0] = "\n".join(lines) + "\n"


def setup(app):
    """Be called by Sphinx."""
    app.connect("source-read", executed)
    app.connect("source-read", grouped)
