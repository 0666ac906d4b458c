"""What `endopilot verify` and `python -m benchmarks verification` print, draw and leave with."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from benchmarks.__main__ import main as benchmarks
from benchmarks.verification import contact, engine, kirchhoff, motion, order, stability, transmission, tube, tubes
from endopilot.cli import main
from endopilot.verification import free_rod
from endopilot.verification.case import Case, compare

KEYS = ["case", "reference", "value", "error", "bar", "passed"]


@pytest.fixture
def cases(monkeypatch: pytest.MonkeyPatch) -> list[Case]:
    """The cases that are run, in place of all."""
    found = free_rod.timoshenko()
    for module in (contact, engine, kirchhoff, motion, order, stability, transmission, tube, tubes):
        monkeypatch.setattr(module, "CASES", ())
    monkeypatch.setattr(free_rod, "CASES", (lambda: found,))
    return found


def test_rows_and_figures(cases: list[Case], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as left:
        benchmarks(["verification", "--plots", str(tmp_path / "plots"), "--json"])
    assert left.value.code == 0
    (row,) = json.loads(capsys.readouterr().out)
    assert list(row) == KEYS and row["passed"] is True
    assert [path.name for path in (tmp_path / "plots").iterdir()] == ["Timoshenko-tip.png"]


@pytest.mark.parametrize(("command", "name"), [(main, "verify"), (benchmarks, "verification")])
def test_an_exceeded_bar_fails_the_command(
    command, name: str, cases: list[Case], capsys: pytest.CaptureFixture[str]
) -> None:
    cases.append(compare("failed", 1.0, 1.1, 0.01))
    with pytest.raises(SystemExit) as left:
        command([name, "--json"])
    assert left.value.code == 1
    assert [row["passed"] for row in json.loads(capsys.readouterr().out)] == [True, False]


def test_a_skipped_case_fails_nothing(cases: list[Case], capsys: pytest.CaptureFixture[str]) -> None:
    nothing = float("nan")
    cases.append(Case("other engine", nothing, nothing, nothing, 0.02, skipped="it is not installed"))
    with pytest.raises(SystemExit) as left:
        benchmarks(["verification", "--json"])
    assert left.value.code == 0
    row = json.loads(capsys.readouterr().out)[1]
    assert row == {
        "case": "other engine (skipped: it is not installed)",
        "reference": None,
        "value": None,
        "error": None,
        "bar": 0.02,
        "passed": None,
    }


def test_the_installed_package_verifies_itself(cases: list[Case], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as left:
        main(["verify"])
    assert left.value.code == 0
    said = capsys.readouterr().out
    assert "Timoshenko tip" in said and "python -m benchmarks verification" in said
