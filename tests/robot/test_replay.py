from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from benchmarks.robot.synthetic import drawn, logged_and_true
from endopilot.devices.robot import RobotConfig
from endopilot.devices.stack import Stack
from endopilot.errors import InputError
from endopilot.robot.log import Courses
from endopilot.robot.replay import ReplayConfig, replay_log, summary, usable_episodes
from endopilot.xray.camera import PlanarCamera

FEW = ReplayConfig(rotations=6)


@pytest.fixture(scope="module")
def robot() -> RobotConfig:
    return drawn(3)


@pytest.fixture(scope="module")
def made(fork, wire, robot):
    return logged_and_true(fork, wire, robot, episodes=3, seconds=10.0, seed=3)


@pytest.fixture(scope="module")
def log(made):
    return made[0]


def test_the_robot_that_logged_is_predicted(fork, wire, robot, made) -> None:
    log, true = made
    found = replay_log([log], fork, Stack(wire), robot=robot, config=FEW)
    figures = summary(found)
    assert figures["episodes"] == 3 and figures["error_along_mm"] < 0.2
    ideal = summary(replay_log([log], fork, Stack(wire), robot=RobotConfig(), config=FEW))
    assert ideal["error_along_mm"] > 2 * figures["error_along_mm"]
    assert ideal["error_along_of_the_drive_alone_mm"] > 2 * figures["error_along_of_the_drive_alone_mm"]
    for each in found:
        assert each.given.sum() == round(0.5 * len(each.given)) and not each.given[-1]
        assert np.isfinite(each.simulated).all() and len(each.force) >= len(each.time_s)
    begun = true.reshape(3, -1, 2)[:, 0, 1]
    for each, turn in zip(found, begun, strict=True):  # nobody knows where in its play a wire begins
        off = abs((each.rotation_rad - turn + np.pi) % (2 * np.pi) - np.pi)
        assert off <= each.rotation_known_rad + robot.wire.play_rad / 2
        assert np.pi / FEW.rotations <= each.rotation_known_rad + 1e-9 < 1.0  # half a step at least


def test_an_episode_may_push_farther_in_all_than_the_vessel_is_long(fork, wire, robot) -> None:
    log, _ = logged_and_true(fork, wire, robot, episodes=1, seconds=40.0, seed=5)
    pushed_mm = np.maximum(np.diff(log.command[log.commanded, 0, 0]), 0.0).sum()
    assert pushed_mm > fork.tree.longest_path().abscissa[-1] + 20.0
    assert summary(replay_log([log], fork, Stack(wire), robot=robot, config=FEW))["error_along_mm"] < 0.3


def test_what_a_camera_does_not_see_counts_for_nothing(fork, wire, robot, log) -> None:
    """The camera looks along y: a tip that lies elsewhere in y is the same pixel."""
    camera = PlanarCamera(mm_per_pixel=0.1, columns=(1.0, 0.0, 0.0), rows=(0.0, 0.0, -1.0))
    pixels = dataclasses.replace(log, tip=np.full_like(log.tip, np.nan), pixel=camera.project(log.tip), camera=camera)
    for each in replay_log([pixels], fork, Stack(wire), robot=robot, config=FEW):
        np.testing.assert_allclose(each.in_view[:, 1], 0.0, atol=1e-9)
        apart = each.predicted - each.seen
        np.testing.assert_allclose(each.in_view[:, [0, 2]], apart[:, [0, 2]], atol=1e-9)


def test_tips_are_expected_beside_the_core_s_as_far_as_tips_before_were(fork, wire, robot, log) -> None:
    """A camera is off by 0.6 mm, in the last episode by 1.2: given tips tell that."""
    moved = log.tip + np.outer(0.6 + 0.6 * (log.episode == 2), [0.0, 1.0, 0.0])
    for each in replay_log([dataclasses.replace(log, tip=moved)], fork, Stack(wire), robot=robot, config=FEW):
        np.testing.assert_array_equal(each.predicted[each.given], each.simulated[each.given])
        assert each.errors["in_view"] < 0.7 * np.median(each.core_mm[~each.given])


def test_no_tip_that_is_not_given_is_read(fork, wire, robot, log) -> None:
    one = next(log.episodes())
    later = np.cumsum(one.seen) > 0.5 * one.seen.sum() + 1
    moved = dataclasses.replace(one, tip=one.tip + np.outer(later, [0.0, 0.3, 0.0]))
    (true,), (other,) = (replay_log([each], fork, Stack(wire), robot=robot, config=FEW) for each in (one, moved))
    np.testing.assert_array_equal(other.predicted, true.predicted)


def test_a_wire_keeps_its_rotation_from_one_episode_to_the_next(fork, wire, robot, made) -> None:
    """The same episode twice; the second time half of its tips are seen within 2 mm only, and tell no rotation."""
    log, true = made
    once, off = next(log.episodes()), 2.0 * np.random.default_rng(2).standard_normal((len(log), 3))
    count = len(once) // 2
    blurred = np.concatenate([once.tip[:count] + off[:count], once.tip[count:]])
    again = dataclasses.replace(once, tip=blurred, episode=once.episode + 1, time_s=once.time_s + 100.0)
    names = [name for name, value in vars(once).items() if isinstance(value, np.ndarray)]
    both = {name: np.concatenate([getattr(once, name), getattr(again, name)]) for name in names}
    wrong = []
    for each in (again, dataclasses.replace(once, **both)):
        turned = replay_log([each], fork, Stack(wire), robot=robot, config=FEW)[-1].rotation_rad - true[0, 1]
        wrong.append(abs((turned + np.pi) % (2 * np.pi) - np.pi))
    assert wrong[0] > 1.0 > wrong[1]


def test_what_a_drive_did_before_the_first_tip_is_left_out(fork, robot, log) -> None:
    """The first twenty periods of each episode show no tip; the rest moves the wire as it did."""
    rows = np.concatenate([np.flatnonzero(log.episode == number)[:40] for number in np.unique(log.episode)])
    unseen = dataclasses.replace(log, used=~np.isin(np.arange(len(log)), rows))
    whole, cut = usable_episodes([log], fork)[1], usable_episodes([unseen], fork)[1]
    assert cut.time_s[0] == whole.time_s[40] and cut.commanded.sum() == whole.commanded.sum() - 20
    moved = []
    for each in (whole, cut):
        courses, one = Courses.of([each], robot.wire), np.ones(1)
        at_s = (cut.time_s[cut.seen] - each.time_s[0])[None]
        motion = courses.followed(0, at_s=at_s, latency_s=0 * one, gain=one, play=0 * one)[0, 0]
        moved.append(motion - motion[0])
    np.testing.assert_allclose(moved[1], moved[0], atol=0.02)  # of ramps


def test_a_log_without_tips_is_refused(fork, wire, log) -> None:
    blind = dataclasses.replace(log, used=np.zeros(len(log), dtype=bool))
    with pytest.raises(InputError, match="synthetic: no episode shows the tip 20 times"):
        replay_log([blind], fork, Stack(wire), robot=RobotConfig(), config=FEW)


@pytest.mark.parametrize(("moved", "scale"), [((300.0, 0.0, 0.0), 1.0), ((0.0, 0.0, 0.0), 1000.0)])
def test_tips_of_another_frame_or_unit_are_refused(fork, wire, log, moved, scale) -> None:
    elsewhere = dataclasses.replace(log, tip=scale * log.tip + np.array(moved))
    with pytest.raises(InputError, match=r"^synthetic: tips were seen at x .*, half of them \d+ mm or more from"):
        replay_log([elsewhere], fork, Stack(wire), robot=RobotConfig(), config=FEW)


def test_a_drive_that_goes_beyond_all_vessels_is_refused(fork, wire, log) -> None:
    in_micrometres = dataclasses.replace(log, command=1000 * log.command)
    with pytest.raises(InputError, match=r"^synthetic: translation_mm goes over \d+ mm .* give mm, and times in s$"):
        replay_log([in_micrometres], fork, Stack(wire), robot=RobotConfig(), config=FEW)
