"""The single-file learner of `examples/recurrent_ppo.py` plays, remembers and improves where seeing costs."""

from __future__ import annotations

import runpy
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from endopilot.ladder.submission import read_submission

EXAMPLE = Path(__file__).parents[2] / "examples" / "recurrent_ppo.py"


@pytest.fixture(scope="module")
def learner() -> dict:
    pytest.importorskip("torch")
    return runpy.run_path(str(EXAMPLE))


@pytest.fixture
def worlds(ahead):
    return gymnasium.make_vec(
        "endopilot.env:endopilot/NavigateXray-v0",
        num_envs=4,
        navigations=ahead,
        period_s=0.5,
        autoreset_mode=AutoresetMode.SAME_STEP,
    )


def test_it_trains_and_goes_on(learner, worlds, tmp_path):
    def trained(name: str, start: Path | None = None) -> tuple[np.ndarray, dict]:
        output = tmp_path / f"{name}.npz"
        asked = SimpleNamespace(minutes=0.0, seed=0, tasks=1, output=output, start=start, dearer=0.1)
        return learner["train"](worlds, asked), learner["read"](output)[0]

    episodes, weights = trained("first")
    assert len(episodes) == 4 * (learner["STEPS"] // 4)  # of 2 s each
    assert (episodes[:, 3] >= 1).all() and np.isfinite(episodes).all()
    assert all(values.isfinite().all() for values in weights.values())
    again, more = trained("again")[1], trained("more", tmp_path / "first.npz")[1]
    assert all((weights[name] == again[name]).all() for name in weights)
    assert 0 < max(float((weights[name] - more[name]).abs().max()) for name in weights) < 0.01  # a few steps farther


@pytest.mark.parametrize(("name", "looks"), [("state", False), ("recurrent", True)])
def test_saved_policies_are_scored_again(learner, ahead, name, looks):
    """They find a target straight ahead, each in its own way: by the true state, or by exposures that they ask for."""
    ahead = replace(ahead, seconds=20.0)
    task = SimpleNamespace(name="ahead", ladder=SimpleNamespace(numbers=(0, 1)), ladder_navigation=lambda _: ahead)
    path = EXAMPLE.parent / "policies" / f"{name}.npz"
    ((said, safe, success, count, exposures),) = learner["score"](path, [task])
    assert (said, count) == ("ahead", 2) and 0 < safe <= success <= 2
    assert (exposures > 1) == looks and (exposures == 0) != looks


def test_a_policy_without_tasks_is_not_saved(learner, monkeypatch, capsys, tmp_path):
    monkeypatch.setattr("sys.argv", ["recurrent_ppo.py", "--output", str(tmp_path / "policy.npz"), "--minutes", "0"])
    with pytest.raises(SystemExit) as ended:
        learner["main"]()
    assert ended.value.code == 2 and "--output: " in capsys.readouterr().err and not list(tmp_path.iterdir())


def test_scores_of_tasks_add_up():
    rows = runpy.run_path(str(EXAMPLE.parents[1] / "docs" / "figures" / "unlearned.py"))["rows"]
    driven = read_submission(EXAMPLE.parents[1] / "submissions" / "recurrent.json")
    found = [(one.success and one.safe, one.success, 1) for done in driven.navigations.values() for one in done]
    name, counted, *_ = rows(driven)[-1]
    assert name == "all 8" and counted == "{:d} ({:d}) of {}".format(*np.sum(found, axis=0))
