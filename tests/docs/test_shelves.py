"""The documentation's shelves, a release and the README: short, linked, dated, and as the package is."""

from __future__ import annotations

import re
import runpy
import subprocess
import tomllib
from functools import cache
from pathlib import Path

import pytest

from endopilot import __version__
from endopilot.errors import InputError

ROOT = Path(__file__).parents[2]
CLAIMS = runpy.run_path(str(ROOT / "docs/claims.py"))
WORDS = runpy.run_path(str(ROOT / "docs/words.py"))
PAGES = sorted([*(ROOT / "docs").glob("*.md"), *(ROOT / "docs").glob("commands/*.md")]) + [
    page for shelf in WORDS["BOUNDS"] for page in sorted((ROOT / "docs" / shelf).glob("*.md"))
]
AROUND = [
    ROOT / name
    for name in (
        "README.md",
        "CONTRIBUTING.md",
        "CHANGELOG.md",
        "SECURITY.md",
        "AGENTS.md",
        "CODE_OF_CONDUCT.md",
        "src/core/README.md",
    )
]
LINK = re.compile(r"\]\(((?!https?:|mailto:)[^)#\s]*)(?:#([^)\s]*))?\)")


@cache
def headings(page: Path) -> set[str]:
    """Return the anchors of a page's headings, as GitHub and MyST make them."""
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    plain = [re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", line) for line in re.findall(r"^#+ (.*)$", text, re.MULTILINE)]
    return {re.sub(r"[^\w\- ]", "", line.strip().lower()).replace(" ", "-") for line in plain}


def test_pages_are_within_the_bound_of_their_shelf() -> None:
    assert [str(page) for page, count, bound in WORDS["pages"]() if count > bound] == []


def test_prose_alone_is_counted() -> None:
    page = "# A\n<!-- a:begin -->\nb\n<!-- a:end -->\n| c | – |\n```\nd\n```\n![e](f.png)\nOne – two.\n"
    assert WORDS["words"](page) == 2


@pytest.mark.parametrize("page", [*PAGES, *AROUND], ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page: Path) -> None:
    lost = []
    for path, anchor in LINK.findall(page.read_text(encoding="utf-8")):
        target = (page.parent / path).resolve() if path else page
        if "generated" in target.parts:
            continue  # what sphinx-gallery makes
        if target.suffix in (".png", ".gif") and not (ROOT / "docs/images").exists():
            continue  # an sdist has no pictures
        if not target.exists() or (anchor and target.suffix == ".md" and anchor not in headings(target)):
            lost.append(f"{path}#{anchor}")
    assert lost == []


def test_the_table_of_claims_is_that_of_the_pages() -> None:
    text = (ROOT / "docs/evidence/index.md").read_text(encoding="utf-8")
    table = text.partition("<!-- claims:begin -->\n")[2].partition("\n<!-- claims:end -->")[0]
    assert table == "\n".join(CLAIMS["table"]()), "run: python docs/claims.py"


@pytest.mark.parametrize("page", sorted((ROOT / "docs/evidence").glob("*.md")), ids=lambda page: page.stem)
def test_a_page_of_evidence_claims_something_and_has_the_command(page: Path) -> None:
    claimed = CLAIMS["claims"]().get(page.stem, [])
    assert claimed or page.stem == "index"
    text = " ".join(page.read_text(encoding="utf-8").split())
    assert [each["command"] for each in claimed if each["command"] not in text] == []


def test_a_figure_that_no_page_has_is_named() -> None:
    for place in ("bench | no such row | mean", "bench | Dice | no such column", "none | Dice | mean"):
        with pytest.raises(LookupError, match=r"evidence/imaging\.md: no (row|column)"):
            CLAIMS["cell"]("imaging", place)


def test_pages_that_code_and_messages_name_exist() -> None:
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True)
    if listed.returncode:
        pytest.skip("no git checkout")
    named = set()
    for name in listed.stdout.splitlines():
        path = ROOT / name
        if path.suffix in {".py", ".md", ".yaml", ".toml", ".hpp", ".cpp", ".js"} and path.is_file():
            named |= set(re.findall(r"(?<![\w/])docs/[\w/-]+\.md", path.read_text(encoding="utf-8")))
    assert len(named) > 10
    assert sorted(page for page in named if not (ROOT / page).exists()) == []


def test_the_lines_of_the_start_page_write_the_replay_below_them(tmp_path, monkeypatch) -> None:
    pytest.importorskip("jinja2", reason="the extra `report` is not installed")
    code = re.search(r"```python\n(.*?)```", (ROOT / "docs/index.md").read_text(encoding="utf-8"), re.DOTALL)
    assert code
    monkeypatch.chdir(tmp_path)
    told = {}
    exec(code[1], told)
    assert told["figures"]["reached"] and (tmp_path / "navigation/navigation.html").stat().st_size > 100_000


def test_generators_find_the_marks_that_they_fill() -> None:
    found, lost = 0, []
    for script in [*ROOT.glob("docs/**/*.py"), *ROOT.glob("benchmarks/**/*.py")]:
        text = script.read_text(encoding="utf-8")
        own = re.search(r'^PAGE = "(.+)"$', text, re.MULTILINE)
        for page, mark in re.findall(r'\bfill\(\s*(PAGE|"[^"]+"), "([^"]+)"', text):
            name = own[1] if page == "PAGE" and own else page.strip('"')
            filled = (ROOT / "docs" / name).read_text(encoding="utf-8")
            found += 1
            lost += [(name, mark) for end in ("begin", "end") if filled.count(f"<!-- {mark}:{end} -->") != 1]
    assert found > 20
    assert lost == []


def test_measured_tables_say_when_they_were_made() -> None:
    undated = {
        (page.name, mark)
        for page in (ROOT / "docs/evidence").glob("*.md")
        for mark, text in re.findall(
            r"<!-- (.+?):begin -->\n(.*?)<!-- \1:end -->", page.read_text(encoding="utf-8"), re.S
        )
        if not re.search(r"^Made on \d{4}-\d\d-\d\d", text, re.MULTILINE)
    }
    made_of_files = {("ladder.md", "tasks"), ("ladder.md", "coaxial tasks"), ("leaderboard.md", "scores")}
    made_of_files |= {("index.md", "claims")}
    by_make = {("demo.md", "demo-table"), ("performance.md", "gpu"), ("performance.md", "gpu-recipe")}
    assert undated <= made_of_files | by_make


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


def test_the_readme_is_short() -> None:
    assert len(README.split()) <= 1250


def test_the_readme_s_table_is_that_of_the_pages() -> None:
    table = README.split("<!-- stands:begin -->\n")[1].split("\n<!-- stands:end -->")[0]
    assert table == runpy.run_path(str(ROOT / "docs/readme.py"))["stands"](), "run: python docs/readme.py"


def test_the_start_page_opens_the_replay_at_its_scene() -> None:
    place = re.search(r'src="replay\.html#(\w+)"', (ROOT / "docs/index.md").read_text(encoding="utf-8"))
    page = (ROOT / "src/endopilot/report/templates/navigation.html.j2").read_text(encoding="utf-8")
    assert place and re.search(rf'<section id="{place[1]}">\s*<h2>[^<]*</h2>\s*<figure>\s*<div class="scene">', page)
