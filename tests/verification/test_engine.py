"""The rod core against MuJoCo."""

from __future__ import annotations

import importlib.util

import pytest

from benchmarks.verification import engine

needs_mujoco = pytest.mark.skipif(importlib.util.find_spec("mujoco") is None, reason=engine.MISSING)


@needs_mujoco
@pytest.mark.parametrize("group", engine.CASES, ids=lambda group: group.__name__)
def test_agrees(group) -> None:
    # A chain of rigid links with joints of stiffness EI/l rests where the rod rests: a curved cantilever under a load
    # across its plane (F L²/EI = 2), and a rod pushed 75° far into a bend of 90° without friction.
    for case in group():
        assert case.error <= 0.02, case.case


def test_skipped_without_mujoco(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    rows = [case.row() for group in engine.CASES for case in group()]
    assert len(rows) == 3
    for row in rows:
        assert row["passed"] is None and row["value"] is None
        assert "MuJoCo is not installed" in row["case"]
