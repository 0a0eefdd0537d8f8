"""The pages and notebooks as a site, by Sphinx from the root of the repository: see CONTRIBUTING.md."""

from pathlib import Path

project = "microid"
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.mathjax"]
include_patterns = ["*.md", "docs/**", "benchmarks/*.md", "notebooks/*.ipynb"]
root_doc = "docs/site/index"
html_theme = "furo"
html_show_copyright = False
# Two hyphens begin an option.
smartquotes = False
myst_heading_anchors = 3
nb_execution_mode = "off"
napoleon_use_ivar = True
autodoc_typehints = "none"
autodoc_member_order = "bysource"


def executed(app, name, source):
    """Show a notebook with its outputs where `pytest -m study tests/test_notebooks.py` has left an executed copy."""
    copy = Path(app.srcdir, "build", f"{name}.ipynb")
    if name.startswith("notebooks/") and copy.exists():
        source[0] = copy.read_text(encoding="utf-8")


def setup(app):
    """Be called by Sphinx."""
    app.connect("source-read", executed)
