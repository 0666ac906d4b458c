"""Environments in which seeing costs: exposures, what they measure, and images."""

from __future__ import annotations

import pickle
import warnings
from functools import partial

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env, data_equivalence
from gymnasium.vector import AutoresetMode

from endopilot.devices.robot import DriveConfig, RobotConfig
from endopilot.env.observation import CONTROL_PERIOD_S, EXPOSURE_REWARD, STEP_REWARD
from endopilot.env.single import NavigateEnv
from endopilot.env.vector import NavigateVectorEnv, of_world
from endopilot.simulation.motion import motion_named
from endopilot.tasks.task import in_catheter, reference_navigation
from endopilot.xray.fluoroscope import Fluoroscope, FluoroscopeConfig, TipFinder

same = partial(data_equivalence, exact=True)
TIP, ABSCISSA, DISTANCE, SLACK = slice(9, 32), 9, 11, 31
FORWARD, SEEN_FORWARD = np.array([0.5, 0.2, -1.0]), np.array([0.5, 0.2, 1.0])


@pytest.mark.parametrize("observation", ["xray", "image"])
def test_they_pass_gymnasiums_check_and_are_made_by_name(ahead, observation):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(gymnasium.make("endopilot/NavigateXray-v0", observation=observation, navigations=ahead).unwrapped)
    worlds = gymnasium.make_vec("endopilot/NavigateXray-v0", num_envs=2, navigations=ahead, observation=observation)
    observations, _ = worlds.reset(seed=0)
    assert worlds.observation_space.contains(observations)
    assert worlds.observation_space.contains(worlds.step(worlds.action_space.sample())[0])


def test_an_exposure_shows_the_tip_costs_and_is_kept_until_the_next(ahead):
    env = NavigateEnv(navigations=ahead, observation="xray", robot="ideal")
    start, info = env.reset(seed=0)
    assert start.shape == (32,) and (info["exposures"], info["exposed"]) == (1, True)
    assert start[ABSCISSA] * 100 == pytest.approx(info["tip_abscissa"], abs=1.5)
    before = info["distance_mm"]
    for step in range(1, 6):
        seen, reward, _, _, info = env.step(FORWARD)
        assert reward == pytest.approx(0.1 * (before - info["distance_mm"]) + STEP_REWARD)
        before = info["distance_mm"]
        np.testing.assert_array_equal(seen[TIP], start[TIP])
        assert seen[6] * 10 == pytest.approx(step * CONTROL_PERIOD_S)  # its age
        assert seen[7] * 10 == pytest.approx(info["inserted_length"] - 6.0, abs=1e-5)  # pushed since
        assert seen[0] * 100 == pytest.approx(info["inserted_length"], abs=1e-4)
    seen, reward, _, _, info = env.step(SEEN_FORWARD)
    assert reward == pytest.approx(0.1 * (before - info["distance_mm"]) + STEP_REWARD + EXPOSURE_REWARD)
    assert (info["exposures"], info["exposed"], seen[6], seen[7]) == (2, True, 0.0, 0.0)
    assert seen[ABSCISSA] * 100 == pytest.approx(info["tip_abscissa"], abs=1.5)
    assert seen[DISTANCE] * 100 == pytest.approx(info["distance_mm"], abs=1.5)
    assert seen[SLACK] * 10 == pytest.approx(info["inserted_length"] - seen[ABSCISSA] * 100, abs=1e-4)


@pytest.mark.parametrize("biplane", [True, False])
def test_the_tips_of_all_worlds_are_found_where_a_fluoroscope_finds_each(ahead, wire, biplane):
    anatomies, config = [ahead.anatomy, reference_navigation().anatomy], FluoroscopeConfig(biplane=biplane)
    random, arm = np.random.default_rng(0), np.array([0, 1, 1] * 20)
    lines = [np.concatenate([branch.centerline.points for branch in a.tree.branches]) for a in anatomies]
    tips = np.array([lines[k][random.integers(len(lines[k]))] + random.normal(0, 1.5, 3) for k in arm])
    headings, depths = random.normal(size=(60, 3)), random.uniform(0, 60, 60)
    headings /= np.linalg.norm(headings, axis=1, keepdims=True)
    noise = np.array([np.random.default_rng(k).standard_normal((1 + biplane, 2)) for k in range(60)])
    finder = TipFinder([(anatomy, wire.tip_radius_mm) for anatomy in anatomies], config)
    row, places, *_ = finder.find(arm, tips, headings, depths, noise)
    likeliest = places[np.unique(row, return_index=True)[1]]
    arms = [Fluoroscope(anatomy, wire.tip_radius_mm, config=config) for anatomy in anatomies]
    for k, of in enumerate(arm):
        alone = arms[of].measure(tips[k], headings[k], depths[k], np.random.default_rng(k))
        np.testing.assert_array_equal(alone.position, likeliest[k])


def test_the_drives_loads_are_observed_and_nothing_that_no_robot_measures(ahead):
    env = NavigateVectorEnv(2, navigations=ahead, observation="xray")
    env.reset(seed=0)
    seen, *_, infos = env.step(np.tile(FORWARD, (2, 1)))
    np.testing.assert_allclose(seen[:, 0] * 100, infos["encoder_inserted_length"], rtol=1e-5)
    np.testing.assert_allclose(seen[:, 3] * 0.5, infos["load_n"], rtol=1e-5)
    np.testing.assert_allclose(seen[:, 4] * 0.5, infos["load_nmm"], rtol=1e-4, atol=1e-7)
    assert not np.allclose(infos["encoder_inserted_length"], infos["inserted_length"], atol=1e-3)


def test_images_show_the_wire_where_it_is_and_only_when_exposed(ahead):
    env = NavigateEnv(navigations=ahead, observation="image", pixels=128, robot="ideal")
    start, _ = env.reset(seed=0)
    assert start["image"].shape == (2, 128, 128) and start["measured"].shape == (9,)
    for _ in range(8):
        seen, *_ = env.step(FORWARD)
        np.testing.assert_array_equal(seen["image"], start["image"])
    seen, *_ = env.step(SEEN_FORWARD)
    views = env._worlds._c_arms._of[0]
    for image, old, plane in zip(seen["image"], start["image"], views._planes, strict=True):
        row, column = np.rint(plane.pixel(env.simulator.tip_position[0, 0])).astype(int)
        around = np.ix_(row + np.arange(-2, 3), column + np.arange(-2, 3))
        assert image[around].min() < old[around].min() - 40  # the wire has come here
        assert (image == 255).sum() == 9  # the target
    single = NavigateEnv(navigations=ahead, observation="image", c_arm=FluoroscopeConfig(biplane=False))
    assert single.reset(seed=0)[0]["image"].shape == (1, 64, 64)


PLAY = RobotConfig(encoders_at="motor", jitter_s=0.05, wire=DriveConfig(play_mm=2.4, gain_sd_translation=0.05))
KINDS = {
    "state": {"observation": "state"},
    "catheter": {"observation": "state", "catheter": True},
    "moving": {"observation": "state", "motion": motion_named("heartbeat")},
    "robot": {"observation": "state", "robot": PLAY},
    "xray": {},
    "image": {"observation": "image"},
    "catheter under X-ray": {"catheter": True},
    "random": {"world": "random", "robot": "random"},
}


@pytest.fixture(params=KINDS)
def kind(request, ahead) -> dict:
    """Return arguments of environments whose worlds are to be repeatable."""
    given = {"observation": "xray"} | KINDS[request.param]
    catheter = given.pop("catheter", False)
    return given | {"navigations": in_catheter([ahead], "microcatheter-1.7f")[0] if catheter else ahead}


def test_worlds_are_repeated_to_the_bit_alone_from_a_state_and_from_a_pickle(kind):
    env = NavigateVectorEnv(3, **kind)
    start, _ = env.reset(seed=4)
    assert not same(of_world(start, 0), of_world(start, 1))
    kept, stored = env.state, pickle.dumps(env)
    shape = (20, 3, env.single_action_space.shape[0])  # past the time limit
    actions = np.random.default_rng(0).uniform(-0.5, 1.0, shape).astype(np.float32)
    went = [env.step(row)[:2] for row in actions]
    env.set_state(pickle.loads(pickle.dumps(kept)))
    for (seen, reward), row in zip(went, actions, strict=True):
        again, reward_again, *_ = env.step(row)
        assert same(again, seen) and np.array_equal(reward, reward_again)
    copy, alone = pickle.loads(stored), NavigateVectorEnv(1, **kind)
    assert same(of_world(alone.reset(seed=5)[0], 0), of_world(start, 1))
    for (seen, _), row in zip(went, actions, strict=True):
        assert same(copy.step(row)[0], seen)
        assert same(of_world(alone.step(row[1:2])[0], 0), of_world(seen, 1))
    assert same(env.reset(seed=4)[0], start)


def test_a_robot_starts_an_episode_as_it_would_start_the_first(ahead):
    env = NavigateVectorEnv(2, navigations=ahead, robot="kweon-2021-2d", autoreset_mode=AutoresetMode.DISABLED)
    courses = []
    for _ in range(2):
        env.reset(seed=1)
        courses.append([env.step(np.full((2, 2), 0.7))[0] for _ in range(7)])
    assert same(*courses)
