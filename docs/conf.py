"""Configuration of the documentation: `make docs` builds it into docs/_build."""

from endopilot import __version__

project = "endopilot"
author = "the endopilot authors"
release = __version__
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.viewcode"]
myst_enable_extensions = ["dollarmath", "amsmath"]
myst_heading_anchors = 3  # links to headings, as GitHub has them
html_theme = "furo"
exclude_patterns = ["_build"]
autodoc_typehints = "none"
suppress_warnings = ["myst.header"]
