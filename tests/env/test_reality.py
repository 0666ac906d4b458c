"""What is real in an environment's worlds, and what it shows of them."""

from __future__ import annotations

import pickle
from dataclasses import replace

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from endopilot.devices.robot import DriveConfig, RobotConfig, read_robot
from endopilot.env.single import NavigateEnv
from endopilot.env.vector import NavigateVectorEnv
from endopilot.errors import InputError
from endopilot.simulation.world import World
from endopilot.tasks.task import in_catheter, reference_navigation
from toy_tasks import own_tasks

STILL, PUSH = np.zeros((2, 2)), np.tile([0.8, 0.0], (2, 1))


def test_worlds_take_turns_with_what_differs_in_them(ahead):
    other = World(lumen_factor=1.2, tip_stiffness_factor=2.0, ostium_mm=2.0)
    env = NavigateVectorEnv(3, navigations=ahead, world=["nominal", other])
    _, infos = env.reset(seed=0)
    np.testing.assert_allclose(infos["inserted_length"], [6.0, 8.0, 6.0], atol=1e-9)
    set_up = env.simulator.set_up
    assert [anatomy is ahead.anatomy for anatomy in set_up.anatomies] == [True, False, True]
    stiff = [stack.wire.bend_stiffness_n_mm2[0] for stack in set_up.stacks]
    assert stiff[1] == 2 * stiff[0] == 2 * stiff[2]
    observed = NavigateVectorEnv(2, navigations=ahead, world=[World(), World(ostium_mm=2.0)])
    seen, infos = observed.reset(seed=0)
    np.testing.assert_allclose(seen[:, 0] * 100, [6.0, 6.0], atol=1e-5)  # as encoders count
    np.testing.assert_allclose(infos["inserted_length"], [6.0, 8.0], atol=1e-9)


def test_a_nominal_world_gives_the_bits_of_none(ahead):
    envs = [NavigateVectorEnv(2, navigations=ahead, world=world, robot="assumed") for world in (None, "nominal")]
    starts = [env.reset(seed=0)[0] for env in envs]
    assert np.array_equal(*starts)
    assert np.array_equal(*[env.step(PUSH)[0] for env in envs])


def test_a_guiding_catheter_backs_out_and_encoders_do_not_see_it(ahead):
    world = World(backs_out_mm=1.5, backs_out_after_s=0.2)
    for robot in (None, "ideal"):
        env = NavigateVectorEnv(2, navigations=ahead, world=world, robot=robot)
        env.reset(seed=0)
        for _ in range(6):
            seen, *_, infos = env.step(STILL)
        np.testing.assert_allclose(infos["inserted_length"], 4.5, atol=1e-6)
        np.testing.assert_allclose(seen[:, 0] * 100, 6.0, atol=1e-5)


def test_random_worlds_and_robots_differ_by_episode_and_follow_from_the_seed(ahead):
    env = NavigateVectorEnv(2, navigations=ahead, world="random", robot="random")

    def begun(seed: int | None) -> np.ndarray:
        """Return depth, friction and what the drives make of a push, of both worlds."""
        infos = env.reset(seed=seed)[1]
        np.testing.assert_allclose(infos["encoder_inserted_length"], 6.0, atol=0.2)
        depth, friction = infos["inserted_length"], env.simulator.set_up.friction[:, 0]
        deeper = [env.step(PUSH)[4]["inserted_length"] for _ in range(4)][-1]
        return np.concatenate([depth, friction, deeper - depth])

    first, second, again = begun(0), begun(None), begun(0)
    assert len(set(first.tolist())) == 6 and not np.isin(second, first).any()
    np.testing.assert_array_equal(again, first)


def test_robots_take_turns_and_a_world_may_have_its_own(ahead):
    slow = RobotConfig(latency_s=0.4, wire=DriveConfig(encoder_sd_mm=1e-9))
    env = NavigateVectorEnv(2, navigations=ahead, robot=[slow, "ideal"])
    env.reset(seed=0)
    moved = [env.step(PUSH)[4]["inserted_length"] - 6.0 for _ in range(2)][-1]
    assert moved[0] == pytest.approx(0.0, abs=1e-6) and moved[1] == pytest.approx(0.8 * 12 * 4 / 15, abs=0.05)
    env = NavigateVectorEnv(2, navigations=ahead, world=[World(robot=slow), "nominal"])
    env.reset(seed=0)
    moved = [env.step(PUSH)[4]["inserted_length"] - 6.0 for _ in range(2)][-1]
    assert moved[0] == pytest.approx(0.0, abs=1e-6) and moved[1] > 2.0
    slipping = replace(read_robot("ideal"), wire=DriveConfig(grip_n=0.01))
    held = NavigateVectorEnv(2, navigations=ahead, world=World(robot=slipping))
    assert held.simulator.set_up.stacks[0].wire.push_limit_n == 0.01


def test_another_engine_moves_the_wires(ahead):
    env = NavigateVectorEnv(2, navigations=ahead, world="other-engine")
    env.reset(seed=0)
    *_, infos = env.step(PUSH)
    np.testing.assert_allclose(infos["inserted_length"], 6.0 + 0.8 * 12 * 2 / 15, atol=1e-6)
    own = NavigateVectorEnv(2, navigations=ahead)
    own.reset(seed=0)
    own.step(PUSH)
    off = np.linalg.norm(env.simulator.tip_position - own.simulator.tip_position, axis=-1)
    assert (off > 0.0).all() and (off < 0.3).all()
    env.reset(seed=0)
    np.testing.assert_array_equal(env.step(PUSH)[4]["inserted_length"], infos["inserted_length"])


def test_a_folder_of_tasks_is_an_environment(tmp_path):
    own_tasks(tmp_path)
    env = gymnasium.make_vec("endopilot/Navigate-v0", num_envs=3, version=str(tmp_path), patients=2)
    assert [navigation.target.abscissa for navigation in env.unwrapped.navigations] == [20.0, 30.0, 20.0]
    one = NavigateEnv(version=str(tmp_path), task="along", patient=1)
    assert one.reset(seed=0)[1]["distance_mm"] == pytest.approx(28.0, abs=0.5)
    with pytest.raises(InputError, match="task: 'across'; choose from along"):
        NavigateEnv(version=str(tmp_path), task="across")


WIRE, CATHETER, TARGET, TIP = (0, 114, 178), (25, 181, 200), (213, 94, 0), (0, 0, 0)


def pixels(picture: np.ndarray, color: tuple[int, int, int]) -> np.ndarray:
    """Return row and column of the pixels of a colour."""
    return np.argwhere((picture == color).all(axis=-1))


@pytest.fixture(scope="module")
def shown() -> tuple[NavigateEnv, np.ndarray, np.ndarray]:
    """Return an environment with a catheter, and its pictures before and after some pushing."""
    navigation = in_catheter([reference_navigation()], "microcatheter-1.7f")[0]
    env = NavigateEnv(navigations=navigation, render_mode="rgb_array")
    env.reset(seed=0)
    before = env.render()
    for _ in range(20):
        env.step([0.7, 0.0, 0.3, 0.0])
    assert before is not None
    return env, before, env.render()


def test_the_wire_is_where_it_was_pushed(shown):
    env, before, after = shown
    assert len(pixels(after, WIRE)) > len(pixels(before, WIRE)) + 20
    assert len(pixels(after, CATHETER)) > 20 and 30 < len(pixels(before, TARGET)) < 60
    tree = reference_navigation().anatomy.tree
    points = np.concatenate([branch.centerline.points for branch in tree.branches])
    across, up = tree.widest_axes()
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    tip = (env.simulator.tip_position[0, 0] - middle) * 236 / np.ptp(points, axis=0).max()
    from_tip = pixels(after, WIRE) + 0.5 - (128 - tip[up], 128 + tip[across])
    assert np.linalg.norm(from_tip, axis=1).min() < 3.5  # it ends under the dot, 2 pixels in radius
    dot = pixels(after, TIP)
    assert 8 < len(dot) < 20 and np.abs(dot.mean(axis=0) + 0.5 - (128 - tip[up], 128 + tip[across])).max() < 1.0


def test_worlds_show_each_its_own_and_nothing_without_the_mode():
    kinds = {"num_envs": 2, "autoreset_mode": AutoresetMode.DISABLED}
    worlds = NavigateVectorEnv(render_mode="rgb_array", **kinds)
    worlds.reset(seed=0)
    worlds.step([[1.0, 0.0], [0.0, 0.0]])
    first, second = worlds.render()
    assert first.shape == (256, 256, 3) and first.dtype == np.uint8
    assert len(pixels(first, WIRE)) > len(pixels(second, WIRE))
    assert all(map(np.array_equal, pickle.loads(pickle.dumps(worlds)).render(), (first, second)))
    assert NavigateVectorEnv(**kinds).render() is None
