"""The pages as a site, by Sphinx from the root of the repository: see CONTRIBUTING.md."""

project = "microid"
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.mathjax"]
include_patterns = ["*.md", "docs/**", "benchmarks/*.md"]
root_doc = "docs/site/index"
html_theme = "furo"
myst_heading_anchors = 3
napoleon_use_ivar = True
autodoc_typehints = "none"
autodoc_member_order = "bysource"
