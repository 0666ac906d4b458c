"""README.md is short, and its table of evidence is that of the pages."""

from __future__ import annotations

import runpy
from pathlib import Path

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def test_it_is_short() -> None:
    assert len(README.split()) <= 1250


def test_its_table_is_that_of_the_pages() -> None:
    table = README.split("<!-- stands:begin -->\n")[1].split("\n<!-- stands:end -->")[0]
    assert table == runpy.run_path(str(ROOT / "docs/readme.py"))["stands"](), "run: python docs/readme.py"
