"""What a release and the README say agrees with the package."""

from __future__ import annotations

import runpy
import tomllib
from pathlib import Path

import pytest

from endopilot import __version__
from endopilot.errors import InputError

ROOT = Path(__file__).parents[1]
notes = runpy.run_path(str(ROOT / "docs/release.py"))["notes"]
CHANGELOG = """## [Unreleased]

## [2.0.0] - 2030-01-02

### Added
- What is new ([how](CHANGELOG.md)).

## [1.0.0] - 2029-01-01
- The first.
"""
CITATION = "version: 2.0.0\ndate-released: 2030-01-02\n"


@pytest.fixture
def released(tmp_path: Path) -> Path:
    (tmp_path / "CHANGELOG.md").write_text(CHANGELOG)
    (tmp_path / "CITATION.cff").write_text(CITATION)
    return tmp_path


def test_the_version_stands_in_one_place() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    assert project["project"]["dynamic"] == ["version"]
    assert project["tool"]["scikit-build"]["metadata"]["version"]["input"] == "src/endopilot/__init__.py"
    assert f"\nversion: {__version__}\n" in (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert f"\n## [{__version__}] - " in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")


def test_notes_are_the_part_of_the_version(released: Path) -> None:
    link = "https://github.com/endopilot/endopilot/blob/v2.0.0/CHANGELOG.md"
    assert notes("2.0.0", folder=released) == f"# endopilot 2.0.0\n\n### Added\n- What is new ([how]({link})).\n"


@pytest.mark.parametrize(
    ("file", "old", "new", "says"),
    [
        ("CHANGELOG.md", "[2.0.0]", "[2.0.1]", r"\[2.0.0\] is missing or has no date"),
        ("CHANGELOG.md", " - 2030-01-02", "", r"\[2.0.0\] is missing or has no date"),
        ("CHANGELOG.md", "[Unreleased]\n", "[Unreleased]\n- More.\n", r"\[Unreleased\] holds changes"),
        ("CITATION.cff", "2.0.0", "1.0.0", "CITATION.cff: version: 1.0.0; the changelog has 2.0.0"),
        ("CITATION.cff", "01-02", "01-03", "date-released: 2030-01-03; the changelog has 2030-01-02"),
    ],
)
def test_a_release_that_does_not_agree_with_itself_is_refused(released, file, old, new, says) -> None:
    path = released / file
    path.write_text(path.read_text(encoding="utf-8").replace(old, new))
    with pytest.raises(InputError, match=says):
        notes("2.0.0", folder=released)


README = (ROOT / "README.md").read_text(encoding="utf-8")


def test_it_is_short() -> None:
    assert len(README.split()) <= 1250


def test_its_table_is_that_of_the_pages() -> None:
    table = README.split("<!-- stands:begin -->\n")[1].split("\n<!-- stands:end -->")[0]
    assert table == runpy.run_path(str(ROOT / "docs/readme.py"))["stands"](), "run: python docs/readme.py"
