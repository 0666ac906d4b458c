"""Configuration of the documentation: `make docs` builds it into docs/_build and runs every tutorial and example."""

import contextlib
import os
import re
import tempfile
from pathlib import Path

from endopilot import __version__

os.environ.setdefault("OMP_NUM_THREADS", "1")  # torch's threads slow each other down on a busy machine
ROOT = Path(__file__).parents[1]

project = "endopilot"
author = "the endopilot authors"
release = __version__
extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "sphinx_gallery.gen_gallery",
]
myst_enable_extensions = ["dollarmath", "amsmath"]
myst_heading_anchors = 3  # links to headings, as GitHub has them
html_theme = "furo"
html_show_copyright = False  # LICENSE names the holders
html_title = "endopilot"
html_static_path = ["static"]
html_css_files = ["site.css"]
exclude_patterns = ["_build", "tutorials", "gallery"]  # sphinx-gallery reads these two and writes into generated/
autodoc_typehints = "none"
suppress_warnings = ["myst.header", "config.cache"]

sphinx_gallery_conf = {
    "examples_dirs": ["tutorials", "gallery"],
    "gallery_dirs": ["generated/tutorials", "generated/gallery"],
    "filename_pattern": r"\.py$",  # run all of them
    "run_stale_examples": True,  # a tutorial can break although its own text did not change
    "within_subsection_order": "FileNameSortKey",
    "capture_repr": (),
    "download_all_examples": False,
    "first_notebook_cell": "%pip install -q 'endopilot[all] @ git+https://github.com/endopilot/endopilot'",
    "show_signature": False,
    "min_reported_time": 1000,
    "write_computation_times": False,
}


def setup(app):
    """Have docstrings read as they were meant: shapes such as `*each 3`, and the tables of the environments."""
    app.connect("autodoc-process-docstring", _read_as_meant, priority=900)  # after napoleon
    app.connect("build-finished", _run_the_start_page)


def _run_the_start_page(app, failure):
    """Run the Python of the start page, which shows the replay that its lines write."""
    if failure is None and app.builder.format == "html":
        code = re.search(r"```python\n(.*?)```", (ROOT / "docs" / "index.md").read_text(encoding="utf-8"), re.DOTALL)
        with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
            exec(code[1], {})
            Path(app.outdir, "replay.html").write_bytes(Path("navigation/navigation.html").read_bytes())


def _read_as_meant(app, what, name, obj, options, lines):
    read, in_table = [], False
    for line in lines:
        table = line.startswith("|")
        if table and not in_table:
            read += ["::", ""]
        elif in_table and not table:
            read.append("")
        in_table = table
        read.append(f"    {line}" if table else re.sub(r"(?<=:type: )(.*)", r"``\1``", line))
    lines[:] = read
