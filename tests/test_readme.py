"""README.md: short, its table of evidence is that of the pages; links of all pages lead somewhere."""

from __future__ import annotations

import re
import runpy
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PICTURES = ROOT / "docs/images"
"""Not part of the sdist."""
README = (ROOT / "README.md").read_text(encoding="utf-8")
PAGES = [*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"), *ROOT.glob("src/**/*.md")]
LINK = re.compile(r"\]\(([^)\s#]*)(?:#([^)\s]*))?\)")


def test_it_is_short() -> None:
    assert len(README.split()) <= 1250


def test_its_table_is_that_of_the_pages() -> None:
    table = README.split("<!-- stands:begin -->\n")[1].split("\n<!-- stands:end -->")[0]
    assert table == runpy.run_path(str(ROOT / "docs/readme.py"))["stands"](), "run: python docs/readme.py"


@cache
def anchors(page: Path) -> set[str]:
    """Return the headings of a page as links name them."""
    headings = re.findall(r"^#+ (.*)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page: Path) -> None:
    wrong = []
    for path, anchor in LINK.findall(re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.M | re.S)):
        target = page.parent / path if path else page
        if re.match("https?:|mailto:|generated/", path) or (path.endswith((".png", ".gif")) and not PICTURES.exists()):
            continue
        if not target.exists() or (anchor and target.suffix == ".md" and anchor not in anchors(target)):
            wrong.append(f"{path}#{anchor}" if anchor else path)
    assert wrong == []
