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
        autoreset_mode=AutoresetMode.SAME_STEP,
    )


def test_it_trains(learner, worlds):
    agent, episodes = learner["train"](worlds, 0.0, 0)
    assert len(episodes) == 4 * (learner["STEPS"] // 15)  # of 2 s each
    assert (episodes[:, 3] >= 1).all() and np.isfinite(episodes).all()
    assert all(parameter.isfinite().all() for parameter in agent.parameters())
    again, _ = learner["train"](worlds, 0.0, 0)
    assert all((a == b).all() for a, b in zip(agent.parameters(), again.parameters(), strict=True))


def test_what_was_remembered_follows_from_the_rollout_s_begin(learner, worlds):
    import torch

    torch.manual_seed(0)
    agent, rollout = learner["Agent"](32, 3), learner["Rollout"](4, 32, 3)
    player = learner["Player"](worlds, 0)
    player.play(agent, rollout)
    player.play(agent, rollout)  # begins with a memory, amid episodes
    memory = rollout.memory
    assert memory.abs().max() > 0 and 0 < rollout.begun.sum() < rollout.begun.numel()
    for observation, begun, value, action, log_prob in zip(
        rollout.observations, rollout.begun, rollout.values, rollout.actions, rollout.log_prob, strict=True
    ):
        memory = agent.remember(observation, memory, begun)
        chances, again = agent.decide(memory)
        torch.testing.assert_close(again, value)
        torch.testing.assert_close(chances.log_prob(action).sum(-1), log_prob)
    fresh = agent.remember(observation, memory, torch.ones(4))
    torch.testing.assert_close(fresh, agent.remember(observation, torch.zeros_like(memory), torch.zeros(4)))


def test_advantages_are_discounted_errors_that_end_with_an_episode(learner):
    import torch

    gamma, lam, rollout = learner["GAMMA"], learner["LAMBDA"], learner["Rollout"](1, 32, 3)
    rollout.rewards[-3:, 0] = torch.tensor([1.0, 2.0, 3.0])
    rollout.ended[-2] = 1.0
    found = rollout.advantages(torch.tensor([10.0]))[-3:, 0]
    torch.testing.assert_close(found, torch.tensor([1.0 + gamma * lam * 2.0, 2.0, 3.0 + gamma * 10.0]))


@pytest.mark.parametrize(("name", "looks"), [("state", False), ("xray", True)])
def test_saved_policies_are_scored_again(learner, ahead, monkeypatch, name, looks):
    """They find a target straight ahead, each in its own way: by the true state, or by exposures that they ask for."""
    ahead = replace(ahead, seconds=20.0)
    task = SimpleNamespace(name="ahead", ladder=SimpleNamespace(numbers=(0, 1)), ladder_navigation=lambda _: ahead)
    monkeypatch.setitem(learner["score"].__wrapped__.__globals__, "list_tasks", lambda: (task,))
    ((said, safe, success, count, exposures),) = learner["score"](EXAMPLE.parent / "policies" / f"{name}.pt")
    assert (said, count) == ("ahead", 2) and 0 < safe <= success <= 2
    assert (exposures > 1) == looks and (exposures == 0) != looks


def test_a_policy_without_tasks_is_not_saved(learner, monkeypatch, capsys, tmp_path):
    monkeypatch.setattr("sys.argv", ["recurrent_ppo.py", "--output", str(tmp_path / "policy.pt"), "--minutes", "0"])
    with pytest.raises(SystemExit) as ended:
        learner["main"]()
    assert ended.value.code == 2 and "--output: " in capsys.readouterr().err and not list(tmp_path.iterdir())
