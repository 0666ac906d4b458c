"""The commands of the guide and the examples run."""

from __future__ import annotations

import re
import runpy
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
GUIDE = runpy.run_path(str(ROOT / "docs/guide.py"))
PAGES = GUIDE["pages"]()


def without_figures(text: str) -> str:
    """Return a text with its figures blotted out: other processors and libraries change their last digits."""
    return re.sub(r"\d+(\.\d+)?(e-?\d+)?", "0", text)


@pytest.fixture(scope="module")
def walked(tmp_path_factory):
    """Return a function that walks a page once, and the pages before it, and returns each block with what was made."""
    folder = tmp_path_factory.mktemp("guide")
    done: dict[Path, list] = {}

    def walk(page: Path) -> list:
        for each in PAGES[: PAGES.index(page) + 1]:
            if each not in done:
                done[each] = list(GUIDE["walk"](each, folder))
        return done[page]

    return walk


@pytest.mark.parametrize("page", PAGES, ids=[page.stem for page in PAGES])
def test_a_page_is_as_its_commands_are(walked, page, monkeypatch) -> None:
    monkeypatch.setenv("COLUMNS", "120")
    for block, made in walked(page):
        if block.kind == "console":
            assert without_figures(block.text) == without_figures(made)
        elif block.kind == "text":
            assert without_figures(block.text) == without_figures(GUIDE["renewed"](block, made))
        elif block.kind == "columns":
            named = [name for row in block.text.splitlines() for name in re.findall(r"`([^`]+)`", row.split("|")[1])]
            assert set(named) - {block.file.rpartition("/")[2]} <= set(made.split(","))
        else:
            assert Path(made).stat().st_size > 0


def test_all_pages_are_walked() -> None:
    assert {page.name for page in PAGES} | {"index.md"} == {page.name for page in (ROOT / "docs/guide").glob("*.md")}


FOLDER = ROOT / "examples"
NEEDS_MORE = {"offline_sets.py", "recurrent_ppo.py", "robot_bag.py", "segment_wire.py", "train_sb3.py"}
"""Examples that train for minutes, or need data or a library of their own."""
EXAMPLES = sorted(path.name for path in FOLDER.glob("*.py") if path.name not in NEEDS_MORE)


@pytest.mark.parametrize("name", EXAMPLES)
def test_an_example_runs_and_its_assertion_holds(name, tmp_path, monkeypatch):
    assert "    assert " in (FOLDER / name).read_text(encoding="utf-8") and len(EXAMPLES) > 5
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(FOLDER)
    monkeypatch.setattr(sys, "argv", [name])
    runpy.run_path(str(FOLDER / name), run_name="__main__")
