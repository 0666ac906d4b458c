"""Print the notes of the release whose version is in src/endopilot/__init__.py: `make release` writes them into dist/.

They are the version's part of CHANGELOG.md. A release that does not agree with itself is refused in one line.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

import yaml

from endopilot import __version__
from endopilot.errors import InputError

ROOT = Path(__file__).parents[1]
REPOSITORY = "https://github.com/endopilot/endopilot"
HEADING = re.compile(r"^## \[([^\]]+)\](?: - (\d{4}-\d{2}-\d{2}))?$", re.MULTILINE)


def notes(version: str = __version__, *, folder: Path = ROOT) -> str:
    """Return the notes of a version in Markdown, with links that hold outside the repository.

    Args:
        version: of the package.
        folder: holds CHANGELOG.md and CITATION.cff.

    Raises:
        InputError: the changelog has no such version, has no date for it or lists changes that are not released, or
            CITATION.cff names another version or date.
    """
    _, *parts = HEADING.split((folder / "CHANGELOG.md").read_text(encoding="utf-8"))
    changes = {name: (date, text.strip()) for name, date, text in zip(*[iter(parts)] * 3, strict=True)}
    date, text = changes.get(version, (None, ""))
    if date is None or not text:
        raise InputError(f"CHANGELOG.md: [{version}] is missing or has no date; add ## [{version}] - YYYY-MM-DD")
    if changes.get("Unreleased", (None, ""))[1]:
        raise InputError(f"CHANGELOG.md: [Unreleased] holds changes; move them below [{version}]")
    cited = yaml.safe_load((folder / "CITATION.cff").read_text(encoding="utf-8"))
    for field, value in {"version": version, "date-released": date}.items():
        if str(cited[field]) != value:
            raise InputError(f"CITATION.cff: {field}: {cited[field]}; the changelog has {value}, give that")
    return f"# endopilot {version}\n\n" + re.sub(r"\]\((?!https?:)", f"]({REPOSITORY}/blob/v{version}/", text) + "\n"


if __name__ == "__main__":
    try:
        print(notes(), end="")
    except InputError as error:
        sys.exit(f"docs/release.py: {error}")
