"""Stable-Baselines3 is given the worlds of a vector environment, and what it looks for at the end of an episode."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest

from endopilot.tasks.navigation import Navigation, Target


@pytest.fixture
def near(fork, wire) -> Navigation:
    return Navigation(anatomy=fork, device=wire, target=Target(branch=1, abscissa=38.0), seconds=0.6)


def test_its_worlds_are_those_of_gymnasium_and_its_algorithms_take_them(near):
    sb3 = pytest.importorskip("stable_baselines3")
    from endopilot.env.sb3 import make_vec

    worlds = make_vec("endopilot/Navigate-v0", num_envs=3, navigations=near)
    same = gymnasium.make_vec("endopilot/Navigate-v0", num_envs=3, navigations=near, autoreset_mode="SameStep")
    worlds.seed(5)
    np.testing.assert_array_equal(worlds.reset(), same.reset(seed=5)[0])
    actions = np.random.default_rng(0).uniform(-1, 1, (6, 3, 2))
    for number, row in enumerate(actions):
        seen, rewards, ended, infos = worlds.step(row)
        wanted, earned, _, truncated, info = same.step(row)
        np.testing.assert_array_equal(seen, wanted)
        np.testing.assert_array_equal(rewards, np.float32(earned))
        assert ended.tolist() == truncated.tolist() == [number == 4] * 3
        for world, said in enumerate(infos if number == 4 else ()):
            np.testing.assert_array_equal(said["terminal_observation"], info["final_obs"][world])
            assert said["TimeLimit.truncated"] and said["is_success"] is False
            assert said["distance_mm"] == info["final_info"]["distance_mm"][world]
    np.testing.assert_array_equal(worlds.reset(), same.reset()[0])  # the generators go on
    assert worlds.get_attr("num_envs", indices=[1]) == [3] and not worlds.has_attr("nothing")
    with pytest.raises(NotImplementedError, match="reset: the worlds are stepped together"):
        worlds.env_method("reset")
    model = sb3.PPO("MlpPolicy", worlds, n_steps=8, batch_size=8, n_epochs=1, device="cpu")
    assert model.learn(24).num_timesteps == 24
