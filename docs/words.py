"""Count the words of the documentation's pages: `python docs/words.py`. A page stays within the bound of its shelf."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

FOLDER = Path(__file__).parent
BOUNDS = {"guide": 400, "concepts": 1000, "evidence": 200}
"""Most words of a page's prose, by its shelf."""
LONGER = {
    "evidence/anatomy.md": 330,
    "evidence/detection.md": 420,
    "evidence/environments.md": 410,
    "evidence/leaderboard.md": 290,
    "evidence/planning.md": 330,
    "evidence/reality.md": 1200,
    "evidence/robustness.md": 250,
    "evidence/worlds.md": 380,
}
"""Pages that are still longer than their shelf allows, and their own bounds: a ratchet, lowered as they get shorter."""
_GENERATED = r"<!-- (.+?):begin -->.*?<!-- \1:end -->"
_NO_PROSE = (
    r"^```.*?^```",  # commands, code
    r"^(?:\||#).*?$",  # tables, headings
    r"!\[[^\]]*\]\([^)]*\)",  # pictures
)


def own(text: str) -> str:
    """Return a page without what scripts write into it."""
    return re.sub(_GENERATED, "", text, flags=re.DOTALL)


def words(text: str) -> int:
    """Return how many words of prose a page has."""
    text = own(text)
    for pattern in _NO_PROSE:
        text = re.sub(pattern, "", text, flags=re.DOTALL | re.MULTILINE)
    return sum(bool(re.search(r"\w", word)) for word in text.split())


def pages() -> Iterator[tuple[Path, int, int]]:
    """Yield the pages of the shelves, each with its words and the bound."""
    for shelf, bound in BOUNDS.items():
        for page in sorted((FOLDER / shelf).glob("*.md")):
            name = page.relative_to(FOLDER)
            yield name, words(page.read_text(encoding="utf-8")), LONGER.get(str(name), bound)


if __name__ == "__main__":
    print("| page | words | bound |\n| --- | --- | --- |")
    for page, count, bound in pages():
        print(f"| {page} | {count} | {bound} |")
