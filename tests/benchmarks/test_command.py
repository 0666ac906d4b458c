"""`python -m benchmarks`: its list, what it refuses, how it judges, and the comparison with another checkout."""

from __future__ import annotations

import json
import re
import shlex
from pathlib import Path

import pytest

from benchmarks import __main__ as command
from benchmarks import against
from benchmarks.figures import Bar, all_passed

ROOT = Path(__file__).parents[2]
SHOWN = re.compile(r"python -m benchmarks ([a-z][a-z-]*)((?: [^\n`|&;]*)?)")
OPTION = re.compile(r"(?<=\s)--[a-z][a-z0-9-]*")
HELP = "`python -m benchmarks judges --help` lists the options"
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "Makefile", *sorted((ROOT / "docs").rglob("*.md"))]


def left_with(arguments: list[str]) -> int:
    with pytest.raises(SystemExit) as left:
        command.main(arguments)
    return left.value.code


def test_help_lists_every_benchmark(capsys: pytest.CaptureFixture[str]) -> None:
    command.main([])
    said = capsys.readouterr().out
    assert all(re.search(rf"^  {name} +[A-Z].*\.$", said, re.MULTILINE) for name in command.BENCHMARKS)


def test_commands_in_the_docs_exist(capsys: pytest.CaptureFixture[str]) -> None:
    found: dict[str, set[str]] = {}
    for page in PAGES:
        for name, rest in SHOWN.findall(page.read_text(encoding="utf-8")):
            found.setdefault(name, set()).update(OPTION.findall(rest))
    assert len(found) > 10
    for name, options in found.items():
        assert left_with([name, "--help"]) == 0, f"{name}: {capsys.readouterr().err}"
        said = capsys.readouterr().out
        known = {*OPTION.findall(f" {said}"), "--json", "--against", "--rounds"}
        assert options <= known, (name, options - known)


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (["simulaton"], "benchmarks simulaton: there is none of this name; `python -m benchmarks --help` lists them"),
        (["labels", "--count", "0"], "benchmarks labels: count: 0; give a whole number from 1 to 1000000"),
        (["anatomy", "--against", "vmtk", "--x"], f"benchmarks judges: unrecognized arguments: --x; {HELP}"),
        (
            ["env", "--against", "nowhere"],
            "benchmarks env: nowhere: has no .venv/bin/python; `make test` makes it",
        ),
    ],
)
def test_bad_input_is_refused_in_one_line(arguments: list[str], line: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert left_with(arguments) == 2
    assert capsys.readouterr().err == line + "\n"


def test_a_missed_bar_is_found_wherever_it_stands() -> None:
    assert all_passed({"a": 1, "rows": [{"passed": None}, {"passed": True}], "passed": {"a": True}})
    for figures in ({"passed": False}, {"passed": {"a": False}}, {"rows": [{"passed": False}]}, [{"passed": False}]):
        assert not all_passed(figures)
    assert Bar(2.0).met(2.0) and not Bar(2.0).met(2.1) and not Bar(2.0).met(float("nan"))
    assert Bar(2.0, at_least=True).met(2.0) and not Bar(2.0, at_least=True).met(1.9)


def python_that_prints(path: Path, *outputs: dict) -> Path:
    """Make a program that prints one of the outputs after another, whatever its arguments are."""
    path.parent.mkdir(parents=True)
    for number, output in enumerate(outputs):
        (path.parent / f"{number}.json").write_text(json.dumps(output))
    count = shlex.quote(str(path.parent / "count"))
    path.write_text(
        f"#!/bin/sh\nn=$(cat {count} 2>/dev/null || echo 0)\necho $((n + 1)) > {count}\n"
        f'echo "$PWD $@" >> {shlex.quote(str(path.parent / "calls"))}\ncat {shlex.quote(str(path.parent))}/$n.json\n'
    )
    path.chmod(0o755)
    return path


def test_another_checkout_is_measured_in_turns(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    theirs = [{"speed": speed, "rows": [{"s": 4}], "passed": True, "gone": 1} for speed in (100, 50, 80)]
    ours = [{"speed": speed, "rows": [{"s": 2}], "passed": True, "name": "x"} for speed in (110, 60, 60)]
    there = python_that_prints(tmp_path / "older" / ".venv" / "bin" / "python", *theirs)
    here = python_that_prints(tmp_path / "here" / "python", *ours)
    monkeypatch.setattr(against.sys, "executable", str(here))
    assert left_with(["scaling", "--against", str(tmp_path / "older"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == [
        {"figure": "speed", "theirs": 80, "ours": 60, "ours_over_theirs": 1.1},
        {"figure": "rows.0.s", "theirs": 4, "ours": 2, "ours_over_theirs": 0.5},
    ]
    calls = (there.parent / "calls").read_text().splitlines()
    assert calls == [f"{tmp_path / 'older'} -m endopilot.cli bench scaling --json"] * 3
    assert (here.parent / "calls").read_text().splitlines() == [f"{ROOT} -m benchmarks scaling --json"] * 3
