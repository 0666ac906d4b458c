"""`examples/train_sb3.py` learns with the hyperparameters of its files, and is judged by what it drives."""

from __future__ import annotations

import runpy
from pathlib import Path

import numpy as np
import pytest
import yaml

EXAMPLE = Path(__file__).parents[2] / "examples" / "train_sb3.py"


@pytest.fixture(scope="module")
def example() -> dict:
    pytest.importorskip("stable_baselines3")
    return runpy.run_path(str(EXAMPLE))


@pytest.mark.parametrize("name", ["endopilot/Navigate-v0", "endopilot/NavigateXray-v0"])
@pytest.mark.parametrize("algorithm", ["ppo", "sac"])
def test_who_learns_is_as_the_file_says(example, algorithm, name):
    model = example["make_model"](algorithm, name, seed=0)
    file = yaml.safe_load((EXAMPLE.parent / "rl_zoo" / f"{algorithm}.yml").read_text(encoding="utf-8"))[name]
    assert {"n_envs", "n_timesteps", "policy"} <= file.keys()  # without which RL Zoo does not begin
    for key in ("n_envs", "gamma", "batch_size", "learning_rate"):
        assert getattr(model, key) == file[key]
    assert model.policy.net_arch == file["policy_kwargs"]["net_arch"]
    model.learn(10**9, callback=example["Clock"](seconds=0.0))
    assert model.num_timesteps == file["n_envs"]  # no time, one step


def test_safe_successes_are_counted(example):
    def shared(forward: float) -> float:
        actions = np.tile([forward, 0.0], (8, 1))
        return example["safe_share"]("endopilot/Navigate-v0", lambda _: actions, seed=0, count=8)

    assert shared(0.0) == 0.0 < shared(5 / 12) < 1.0


def test_intervals_are_over_rotations_and_seeds():
    drawn = runpy.run_path(str(EXAMPLE.parents[1] / "docs" / "figures" / "train_sb3.py"))
    last = [[0.0, 1.0, True]] * 4 + [[0.0, 7.0, True]]
    seeds = [{"steps": steps, "safe": 0.5, "pushed": 0.25, "episodes": last} for steps in (1000, 2000, 3000)]
    row, pushing = drawn["table"]({"ppo": seeds})[2:]
    # Of 32 in 64 by Wilson; Student's 95 % quantile for three seeds is 4.303.
    assert row.split(" | ")[2:] == ["2 000 ± 2 484", "50, 50, 50 (38–62)", "7.00 ± 0.00 |"] and "| 25 |" in pushing
