"""What `endopilot verify` prints, draws and leaves with."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from benchmarks.verification import contact, engine, motion, order, stability, tube, tubes, verify
from endopilot.cli import verify as command
from endopilot.verification import free_rod
from endopilot.verification.case import Case, compare

KEYS = ["case", "reference", "value", "error", "bar", "passed"]


@pytest.fixture
def cases(monkeypatch: pytest.MonkeyPatch) -> list[Case]:
    """The cases that verify runs, in place of all."""
    found = free_rod.timoshenko()
    for module in (contact, engine, motion, order, stability, tube, tubes):
        monkeypatch.setattr(module, "CASES", ())
    monkeypatch.setattr(free_rod, "CASES", (lambda: found,))
    return found


def test_rows_and_figures(cases: list[Case], tmp_path: Path) -> None:
    rows = verify.run_verification(tmp_path / "plots")
    assert [list(row) for row in rows] == [KEYS]
    assert rows[0]["passed"] is True
    assert [path.name for path in (tmp_path / "plots").iterdir()] == ["Timoshenko-tip.png"]


def test_an_exceeded_bar_fails_the_command(cases: list[Case], capsys: pytest.CaptureFixture[str]) -> None:
    cases.append(compare("failed", 1.0, 1.1, 0.01))
    with pytest.raises(SystemExit) as left:
        command.command(json=True)
    assert left.value.code == command.EXIT_FAILED
    assert [row["passed"] for row in json.loads(capsys.readouterr().out)] == [True, False]


def test_a_skipped_case_fails_nothing(cases: list[Case], capsys: pytest.CaptureFixture[str]) -> None:
    nothing = float("nan")
    cases.append(Case("other engine", nothing, nothing, nothing, 0.02, skipped="it is not installed"))
    command.command(json=True)
    row = json.loads(capsys.readouterr().out)[1]
    assert row == {
        "case": "other engine (skipped: it is not installed)",
        "reference": None,
        "value": None,
        "error": None,
        "bar": 0.02,
        "passed": None,
    }
    command.command()
    assert "skipped" in capsys.readouterr().out
