"""What environments show with `render_mode="rgb_array"`."""

from __future__ import annotations

import pickle

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from endopilot.env.single import NavigateEnv
from endopilot.env.vector import NavigateVectorEnv
from endopilot.errors import InputError
from endopilot.tasks.task import in_catheter, reference_navigation

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
    assert len(pixels(after, CATHETER)) > 20
    tree = reference_navigation().anatomy.tree
    points = np.concatenate([branch.centerline.points for branch in tree.branches])
    across, up = tree.widest_axes()
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    tip = (env.simulator.tip_position[0, 0] - middle) * 236 / np.ptp(points, axis=0).max()
    from_tip = pixels(after, WIRE) + 0.5 - (128 - tip[up], 128 + tip[across])
    assert np.linalg.norm(from_tip, axis=1).min() < 3.5  # it ends under the dot, 2 pixels in radius
    dot = pixels(after, TIP)
    assert 8 < len(dot) < 20 and np.abs(dot.mean(axis=0) + 0.5 - (128 - tip[up], 128 + tip[across])).max() < 1.0


def test_what_lies_outside_the_vessel_is_left_out(shown):
    """Before it is pushed some mm of the wire are shown, and not what lies in the guiding catheter behind them."""
    navigation = reference_navigation()
    points = np.concatenate([branch.centerline.points for branch in navigation.anatomy.tree.branches])
    shown_px = (navigation.start_inserted_length_mm + 2.0) * 236 / np.ptp(points, axis=0).max()
    assert len(pixels(shown[1], WIRE)) < 4 * (shown_px + 2)  # a line 3 pixels wide, aslant


def test_the_target_is_a_dot(shown):
    assert 30 < len(pixels(shown[1], TARGET)) < 60


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


def test_gymnasium_makes_them_by_name():
    env = gymnasium.make("endopilot.env:endopilot/Navigate-v0", render_mode="rgb_array")
    env.reset(seed=0)
    assert env.render().shape == (256, 256, 3)


def test_another_mode_is_refused():
    with pytest.raises(InputError, match="render_mode: 'human'"):
        NavigateVectorEnv(render_mode="human")
