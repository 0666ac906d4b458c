"""Count the words of the documentation's pages: `python docs/words.py`. A page stays within the bound of its shelf."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

FOLDER = Path(__file__).parent
BOUNDS = {"guide": 1000, "concepts": 1500, "evidence": 1500}
"""Most words of a page, by its shelf. What stands between marks is generated, and does not count."""


def words(text: str) -> int:
    """Return how many words a page has, without what generators write into it."""
    own = re.sub(r"<!-- (.+?):begin -->.*?<!-- \1:end -->", "", text, flags=re.DOTALL)
    return sum(bool(re.search(r"\w", word)) for word in own.split())


def pages() -> Iterator[tuple[Path, int, int]]:
    """Yield the pages of the shelves, each with its words and the bound."""
    for shelf, bound in BOUNDS.items():
        for page in sorted((FOLDER / shelf).glob("*.md")):
            yield page.relative_to(FOLDER), words(page.read_text(encoding="utf-8")), bound


if __name__ == "__main__":
    print("| page | words | bound |\n| --- | --- | --- |")
    for page, count, bound in pages():
        print(f"| {page} | {count} | {bound} |")
