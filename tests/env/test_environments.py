"""The learning environments: Gymnasium's contract, exact repetition, one dynamics for one world or many."""

from __future__ import annotations

import pickle
import subprocess
import sys
import warnings
from dataclasses import replace

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env, data_equivalence
from gymnasium.vector import AutoresetMode

from endopilot.devices.robot import DriveConfig, RobotConfig
from endopilot.devices.stack import Stack
from endopilot.env.observation import (
    CONTROL_PERIOD_S,
    FORCE_REWARD,
    PROGRESS_REWARD,
    STEP_REWARD,
    SUCCESS_REWARD,
    RouteTables,
)
from endopilot.env.single import NavigateEnv
from endopilot.env.vector import NavigateVectorEnv, of_world
from endopilot.errors import InputError
from endopilot.simulation.motion import motion_named
from endopilot.simulation.simulator import Simulator
from endopilot.tasks.navigation import Navigation, Target
from endopilot.tasks.targets import find_target
from endopilot.tasks.task import in_catheter, reference_navigation
from endopilot.types import TipProjection

WORLDS = 3


@pytest.fixture(scope="module")
def near() -> Navigation:
    """Return a target 25 mm down the reference anatomy, past two side branches, with 3 s to reach it."""
    tree = reference_navigation().anatomy.tree
    branch = next(b for b in tree.route(tree.leaves()[-1]) if tree.branches[b].centerline.abscissa[-1] > 25)
    return replace(reference_navigation(), target=Target(branch=branch, abscissa=25.0), seconds=3.0)


@pytest.mark.parametrize("name", ["Navigate", "NavigateCoaxial"])
def test_the_registered_environments_pass_gymnasiums_check(name):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(gymnasium.make(f"endopilot/{name}-v0").unwrapped)


def test_a_process_that_imported_nothing_makes_environments_by_name():
    code = (
        "import sys, gymnasium\n"
        "gymnasium.make('endopilot.env:endopilot/Navigate-v0').reset(seed=0)\n"
        "gymnasium.register_envs(sys.modules['endopilot'])\n"
        "gymnasium.make_vec('endopilot.env:endopilot/Straight-v2', num_envs=2).reset(seed=0)\n"
        "try:\n    gymnasium.make('endopilot/NavigateXray-v0', observation='sonar')\n"
        "except Exception as error:\n"
        "    assert \"observation: 'sonar'; give one of 'state', 'xray', 'image'\" in str(error)\n"
        "else:\n    raise AssertionError\n"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr


@pytest.mark.parametrize("order", ["endopilot, gymnasium", "gymnasium, endopilot"])
def test_importing_the_package_registers_the_environments_and_not_gymnasium(order):
    code = (
        "import sys, endopilot\nassert not {'gymnasium', 'numpy', 'typing'} & set(sys.modules)\n"
        * order.startswith("e")
        + "import importlib.util\nimportlib.util.find_spec('gymnasium')\n" * order.startswith("e")  # which only asks
        + f"import {order}\nspec = gymnasium.spec('endopilot/Follow-v2')\n"
        "assert spec.max_episode_steps == 1350\n"
        "endopilot.register_envs()\n"
        "assert sum(name.startswith('endopilot/') for name in gymnasium.registry) == 31\n"
    )
    result = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr


def test_episodes_end_when_the_registered_steps_are_over_and_not_before(near):
    env = gymnasium.make("endopilot/Navigate-v0")
    assert env.spec.max_episode_steps == reference_navigation().periods(CONTROL_PERIOD_S)
    long = replace(near, seconds=61.0)
    with pytest.raises(InputError, match="navigations: take up to 458 steps, and the registered environment 450"):
        gymnasium.make("endopilot/Navigate-v0", navigations=long)
    worlds = gymnasium.make_vec("endopilot/Navigate-v0", num_envs=1, navigations=long, max_episode_steps=500)
    assert worlds.num_envs == 1


def test_a_step_where_no_episode_goes_on_is_refused(near):
    one, still = NavigateEnv(navigations=near), np.zeros(2)
    with pytest.raises(ResetNeeded, match="before reset"):
        one.step(still)
    one.reset(seed=0)
    while not one.step(still)[3]:
        pass
    with pytest.raises(ResetNeeded, match="no episode goes on in worlds 0"):
        one.step(still)
    many = NavigateVectorEnv(2, navigations=near)
    many.reset(options={"reset_mask": np.array([True, False])})
    with pytest.raises(ResetNeeded, match="in worlds 1"):
        many.step(np.zeros((2, 2)))


def test_options_that_reset_does_not_know_are_refused_by_name(near):
    with pytest.raises(InputError, match="options: 'patient'; reset takes none, all else is given to make"):
        NavigateEnv(navigations=near).reset(options={"patient": 3})
    with pytest.raises(InputError, match="options: 'patient'; reset takes reset_mask"):
        NavigateVectorEnv(2, navigations=near).reset(options={"patient": 3})


@pytest.mark.parametrize("observation", ["state", "xray", "image"])
def test_worlds_that_end_are_reset_in_the_same_step_where_that_is_asked_for(near, observation):
    """Each world goes on as a single environment that is reset when it ends, to the bit."""
    times = [replace(near, seconds=seconds) for seconds in (0.5, 0.8, 3.0)]
    given = {"observation": observation, "robot": "ideal"}
    env = NavigateVectorEnv(3, navigations=times, autoreset_mode="SameStep", **given)
    singles = [NavigateEnv(navigations=each, **given) for each in times]
    env.reset(seed=3)
    for world, single in enumerate(singles):
        single.reset(seed=3 + world)
    actions = np.random.default_rng(0).uniform(-0.5, 1.0, (9, *env.action_space.shape))
    ends = 0
    for row in actions:
        seen, rewards, terminations, truncations, infos = env.step(row)
        for world, single in enumerate(singles):
            alone, reward, terminated, truncated, info = single.step(row[world])
            assert (reward, terminated, truncated) == (rewards[world], terminations[world], truncations[world])
            over = terminated or truncated
            assert over == bool(infos.get("_final_obs", np.zeros(3))[world])
            if over:
                ends += 1
                assert data_equivalence(infos["final_obs"][world], alone, exact=True)
                final = infos["final_info"]
                assert final["_time_s"][world] and {n: v[world] for n, v in final.items() if n[0] != "_"} == info
                alone, info = single.reset()
            assert data_equivalence(of_world(seen, world), alone, exact=True)
            assert all(infos[name][world] == value for name, value in info.items())
    assert ends == 3


def test_an_anatomy_and_a_target_are_an_environment():
    anatomy = reference_navigation().anatomy
    one, many = NavigateEnv(anatomy, "2"), NavigateVectorEnv(2, anatomy, target="2", patients=1)
    assert one.reset(seed=0)[1] == {name: value[0] for name, value in many.reset(seed=0)[1].items() if name[0] != "_"}
    assert many.navigations[0].target == find_target(anatomy.tree, "2")
    for device, name in (("j-035", "j-035"), (Stack.of("workhorse-014", "microcatheter-1.7f"), None)):
        assert NavigateEnv(anatomy, "2", device=device).simulator.set_up.stacks[0].name == (name or device.name)
    with pytest.raises(InputError, match="anatomy, target: give both"):
        NavigateEnv(anatomy)
    with pytest.raises(InputError, match=r"target: 'G1\.2'; the vessel has no such section"):
        NavigateEnv(anatomy, target="G1.2")


def test_a_single_environment_can_be_pickled_and_restored(near):
    env = NavigateEnv(navigations=near)
    env.reset(seed=3)
    first, second = np.array([[1.0, 0.2], [0.5, 1.0]])
    env.step(first)
    kept = env.state
    copy = pickle.loads(pickle.dumps(env))
    went = env.step(second)
    start = env.reset()[0]
    again = copy.step(second)
    assert np.array_equal(went[0], again[0]) and went[1:4] == again[1:4] and went[4] == again[4]
    assert np.array_equal(copy.reset()[0], start)
    env.set_state(kept)
    assert np.array_equal(env.step(second)[0], went[0])
    assert np.array_equal(env.reset()[0], start)


def test_vessels_move_where_a_motion_is_given_after_the_phase_of_the_ct(near):
    still, env = (
        NavigateVectorEnv(WORLDS, navigations=near, motion=each) for each in (None, motion_named("heartbeat"))
    )
    assert np.array_equal(still.reset(seed=4)[0], env.reset(seed=4)[0])
    pushed = np.tile([0.6, 0.2], (WORLDS, 1))
    lain, moved = ([each.step(pushed)[0] for _ in range(6)] for each in (still, env))
    assert np.abs(np.subtract(moved, lain)).max() > 0.01


def test_reward_is_what_the_table_says_and_success_terminates(near):
    env = NavigateEnv(navigations=near)
    _, info = env.reset(seed=0)
    before, ended = info["distance_mm"], False
    assert before == pytest.approx(20.0, abs=1.0)
    while not ended:
        _, reward, ended, truncated, info = env.step(np.array([1.0, 0.0]))
        expected = PROGRESS_REWARD * (before - info["distance_mm"]) + STEP_REWARD
        expected += FORCE_REWARD * (info["contact_force_max"] > near.force_limit_n) + SUCCESS_REWARD * info["success"]
        assert reward == pytest.approx(expected, abs=1e-9)
        assert not truncated
        before = info["distance_mm"]
    assert info["success"] and info["valid"] and info["safe"] and info["distance_mm"] <= 2.0


def test_a_second_rule_of_a_target_has_to_hold_too(near):
    for near_mm in (3.0, 0.01):  # a tip on the wall lies beside the line
        env, reached = NavigateEnv(navigations=replace(near, target=replace(near.target, near_mm=near_mm))), False
        env.reset(seed=0)
        for _ in range(30):
            _, _, terminated, truncated, info = env.step(np.array([1.0, 0.0]))
            reached |= info["success"]
            if terminated or truncated:
                break
        assert reached == (near_mm == 3.0)


def test_wire_and_catheter_are_driven_and_observed_each_by_itself(near):
    navigation = in_catheter([near], "microcatheter-1.7f")[0]
    env = NavigateEnv(navigations=navigation)
    start, _ = env.reset(seed=0)
    assert start.shape == (39,) and env.action_space.shape == (4,)
    assert start[31] == 0.0 and start[0] == pytest.approx(near.start_inserted_length_mm / 100)
    action = np.array([0.0, 0.0, 0.5, 0.25])
    seen, _, _, _, info = [env.step(action) for _ in range(8)][-1]
    advance, turn = 8 * CONTROL_PERIOD_S * 6.0, 8 * CONTROL_PERIOD_S * 0.25 * 3.14
    assert info["inserted_length"] == pytest.approx(near.start_inserted_length_mm, abs=1e-6)
    assert info["catheter_1_inserted_length"] == pytest.approx(advance, abs=1e-6)
    assert info["catheter_1_rotation"] == pytest.approx(turn, abs=1e-6)
    # the catheter is the foremost now: each tip is told by itself
    assert info["catheter_1_tip_abscissa"] == pytest.approx(advance, abs=0.5)
    assert info["tip_abscissa"] == pytest.approx(near.start_inserted_length_mm, abs=0.5)
    told = [info[f"catheter_1_{name}"] for name in ("inserted_length", "tip_abscissa")]
    assert seen[[31, 34]] == pytest.approx(np.array(told) / 100, abs=1e-6)
    assert seen[32:34] == pytest.approx([np.cos(turn), np.sin(turn)], abs=1e-6)
    assert seen[36] == pytest.approx(info["distance_mm"] / 100, abs=1e-6) and seen[37] == 1.0
    assert seen[5] == pytest.approx((25.0 - info["tip_abscissa"]) / 100, abs=1e-6)


def test_the_catheter_arrives_over_its_wire_and_both_tips_are_rewarded(near):
    navigation = replace(in_catheter([near], "microcatheter-1.7f")[0], seconds=10.0)
    env = NavigateEnv(navigations=navigation)

    def left(info: dict) -> float:
        return info["distance_mm"] + abs(25.0 - info["tip_abscissa"])

    _, info = env.reset(seed=0)
    ended = False
    while not ended:
        action = [1.0, 0.0, 0.0, 0.0] if info["tip_abscissa"] < 25.0 else [0.0, 0.0, 1.0, 0.0]
        before, wire_was_there = left(info), info["tip_abscissa"] >= 25.0
        _, reward, ended, truncated, info = env.step(np.array(action))
        expected = PROGRESS_REWARD * (before - left(info)) + STEP_REWARD + SUCCESS_REWARD * info["success"]
        assert reward == pytest.approx(expected, abs=1e-6)
        assert not truncated and (wire_was_there or not ended)  # the wire is there first, its catheter is not
    assert info["success"] and abs(info["catheter_1_tip_abscissa"] - 25.0) <= 2.0
    # a catheter that arrives with its wire drawn back into it does not count
    env.reset(seed=0)
    for _ in range(20):
        _, _, ended, _, info = env.step(np.array([0.0, 0.0, 1.0, 0.0]))
        assert not info["success"]
    assert info["catheter_1_tip_abscissa"] > 27.0 and info["tip_abscissa"] < 10.0


@pytest.mark.parametrize("period_s", [CONTROL_PERIOD_S, 0.5])
def test_the_time_limit_truncates_and_the_next_step_begins_anew(near, period_s):
    """And time costs the same, however long a step takes."""
    env = NavigateVectorEnv(WORLDS, navigations=near, period_s=period_s)
    still, steps = np.zeros((WORLDS, 2)), int(np.ceil(near.seconds / period_s - 1e-9))
    far, paid = env.reset(seed=0)[1]["distance_mm"], np.zeros(WORLDS)
    for step in range(steps):
        _, rewards, terminations, truncations, infos = env.step(still)
        paid += rewards
        assert not terminations.any()
        assert truncations.all() == (step == steps - 1) == truncations.any()
    assert infos["time_s"][0] == pytest.approx(steps * period_s)
    of_time = STEP_REWARD * steps * period_s / CONTROL_PERIOD_S
    np.testing.assert_allclose(paid, of_time + PROGRESS_REWARD * (far - infos["distance_mm"]), rtol=1e-6)
    _, rewards, terminations, truncations, infos = env.step(np.ones((WORLDS, 2)))
    assert (rewards == 0).all() and not (terminations | truncations).any() and (infos["time_s"] == 0).all()
    assert np.allclose(infos["inserted_length"], near.start_inserted_length_mm)


def test_only_the_worlds_of_the_mask_are_reset(near):
    env = NavigateVectorEnv(WORLDS, navigations=near, autoreset_mode=AutoresetMode.DISABLED)
    env.reset(seed=0)
    before = env.step(np.ones((WORLDS, 2)))[0]
    after, infos = env.reset(options={"reset_mask": np.array([False, True, False])})
    assert np.allclose(after[[0, 2]], before[[0, 2]], atol=1e-6)
    assert infos["time_s"].tolist() == pytest.approx([CONTROL_PERIOD_S, 0.0, CONTROL_PERIOD_S])


def test_a_world_that_fails_terminates_and_says_so(near, monkeypatch):
    env = NavigateVectorEnv(WORLDS, navigations=near, autoreset_mode=AutoresetMode.DISABLED)
    env.reset(seed=0)
    step = Simulator.step

    def failing(self, control, duration):
        done = step(self, control, duration)
        return replace(done, valid=np.array([True, False, True]))

    monkeypatch.setattr(Simulator, "step", failing)
    _, _, terminations, truncations, infos = env.step(np.zeros((WORLDS, 2)))
    assert terminations.tolist() == [False, True, False] == (~infos["valid"]).tolist()
    assert not truncations.any() and not infos["success"].any()


def test_too_large_a_force_is_reported_and_remembered(near):
    env = NavigateEnv(navigations=replace(near, force_limit_n=1e-4))
    env.reset(seed=0)
    infos = [env.step(np.array([1.0, 0.0]))[4] for _ in range(9)]
    unsafe = np.array([info["contact_force_max"] > 1e-4 for info in infos])
    assert unsafe.any()
    assert [info["safe"] for info in infos] == (~np.maximum.accumulate(unsafe)).tolist()


def test_a_wrong_branch_lengthens_the_route():
    navigation = reference_navigation()
    tree = navigation.anatomy.tree
    route, fork = tree.route(navigation.target.branch), tree.branches[0].centerline.abscissa[-1]
    side = next(i for i in range(len(tree.branches)) if i not in route and tree.branches[i].parent == 0)
    one = np.ones((1, 1))
    tip = TipProjection(abscissa=(fork + 7.0) * one, offset=0.0 * one, branch=side * one.astype(int), radius=one)
    routes = RouteTables.of([navigation])
    assert routes.distance(tip) == pytest.approx(7.0 + navigation.target.abscissa - fork)
    assert not routes.on_route(tip).any()


@pytest.mark.parametrize("action", [np.full((WORLDS, 2), np.nan), np.zeros((WORLDS, 3)), np.zeros(2)])
def test_bad_actions_are_refused(near, action):
    env = NavigateVectorEnv(WORLDS, navigations=near)
    env.reset(seed=0)
    with pytest.raises(InputError, match="actions"):
        env.step(action)


def test_pushing_on_for_ever_stops_at_the_end_of_the_wire():
    navigation = replace(reference_navigation(), seconds=60.0, start_inserted_length_mm=130.0)
    env = NavigateEnv(navigations=navigation)
    env.reset(seed=0)
    longest = navigation.anatomy.tree.longest_path().abscissa[-1]
    for _ in range(30):
        _, _, terminated, _, info = env.step(np.array([1.0, 1.0]))
        assert info["inserted_length"] <= longest + 20.0 + 1e-9
        if terminated:
            break


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"num_envs": 0}, "num_envs: 0"),
        ({"navigations": None, "task": "moon"}, "task: 'moon'"),
        ({"navigations": None, "catheter": "hose"}, "catheter 'hose'"),
        ({"catheter": "microcatheter-1.7f"}, r"catheter: microcatheter-1\.7f; give it to the navigations"),
        ({"device": "j-035"}, "device: give it with anatomy and target, or to the navigations"),
        ({"robot": "none"}, "robot 'none': no such robot or file"),
        ({"render_mode": "human"}, "render_mode: 'human'"),
        ({"observation": "image", "pixels": 32}, "pixels: 32; give 64 to 128"),
        ({"world": "none"}, "world 'none': no such world or file"),
        ({"world": []}, "an empty list"),
        ({"num_envs": 2, "world": ["nominal", "fine-core"]}, "world: worlds differ in core or wall"),
        ({"num_envs": 2, "world": ["moving", "nominal"]}, "world: worlds differ in motion"),
        ({"num_envs": 2, "world": ["nominal", "other-engine"]}, "world: worlds differ in engine"),
    ],
)
def test_bad_arguments_are_one_clear_line(near, change, message):
    with pytest.raises(InputError, match=message):
        NavigateVectorEnv(**({"navigations": near} | change))


def test_navigations_that_do_not_go_together_are_refused(near):
    coaxial = in_catheter([near], "microcatheter-1.7f")[0]
    with pytest.raises(InputError, match="navigations: differ in catheters"):
        NavigateVectorEnv(2, navigations=[near, coaxial])
    with pytest.raises(InputError, match="arrives: catheter; there is none"):
        replace(coaxial, catheters=())
    slow = replace(near, device=replace(near.device, max_velocity_mm_s=1.0))
    with pytest.raises(InputError, match="max_velocity_mm_s"):
        NavigateVectorEnv(1, navigations=slow)


PLAY = RobotConfig(
    encoders_at="motor", jitter_s=0.05, wire=DriveConfig(play_mm=2.4, play_rad=1.0, gain_sd_translation=0.05)
)


def test_a_robot_drives_and_its_encoders_are_observed(near):
    env = NavigateVectorEnv(WORLDS, navigations=near, robot=PLAY)
    begun = env.reset(seed=2)[0]
    for push in (1.0, 1.0, 1.0, -1.0):
        observation, *_, infos = env.step(np.tile([[push, 0.0]], (WORLDS, 1)))
    moved = 2 / 15 * 12.0 * (3 - 1)
    motor = infos["encoder_inserted_length"] - near.start_inserted_length_mm
    assert (np.abs(motor - moved) < 12.0 * 0.1 * 2 + 0.2).all()  # latency, jitter and ramps
    assert (np.abs(infos["inserted_length"] - infos["encoder_inserted_length"]) > 0.2).all()  # play and gain
    np.testing.assert_allclose(observation[:, 0], infos["encoder_inserted_length"] / 100.0, rtol=1e-5)
    np.testing.assert_allclose(observation[:, 1], np.cos(infos["encoder_rotation"]), rtol=1e-4, atol=1e-6)
    assert np.ptp(infos["load_n"]) > 0 and np.ptp(begun[:, 0]) > 0  # noise of their own
    named = NavigateVectorEnv(1, navigations=near, robot="kweon-2021-2d")
    assert "load_nmm" in named.reset(seed=0)[1]


def test_stable_baselines3_takes_the_worlds_and_finds_what_it_looks_for_at_an_end(ahead):
    sb3 = pytest.importorskip("stable_baselines3")
    from endopilot.env.sb3 import make_vec

    near = replace(ahead, seconds=0.6)

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
