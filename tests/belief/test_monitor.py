"""A wire followed under a belief: whether a wrong model is noticed, by images and by loads, and what is identified."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from endopilot.belief.drives import ahead_of_valve_n
from endopilot.belief.monitor import BelievedTip, LoadRatio, Monitor
from endopilot.belief.thought import Pace
from endopilot.belief.watch import ASSUMED_SD_MM, MISMATCH, Innovations
from endopilot.control.agent_config import read_agent_calibration
from endopilot.devices.robot import DriveConfig, RobotConfig
from endopilot.navigation.loop import NavigationLoop
from endopilot.navigation.policy import Decision, Observation
from endopilot.simulation.motion import Motion
from endopilot.simulation.world import World
from endopilot.tasks.navigation import Navigation, Target

HALF_MM = np.array([0.8, 0.2])


class ToAndFro:
    """Pushes, turns and pulls, whatever is believed, and asks for X-ray as a monitor does."""

    def start(self, navigation: Navigation, seed: int) -> None:
        self.monitor, self.last = Monitor(navigation, read_agent_calibration("assumed", 1)), BelievedTip(0.0, 0.0)
        self.alarmed, self.exposures = 0, 0

    def believed_wires(self) -> np.ndarray:
        return self.monitor.belief.simulator.position

    def believed(self) -> BelievedTip:
        return self.last

    def decide(self, observation: Observation) -> Decision:
        self.exposures += observation.tip is not None
        self.last = self.monitor.step(observation.devices, observation.load, observation.tip)
        self.alarmed += MISMATCH in self.last.asks
        slow = -1 if int(observation.time_s / 4) % 3 == 2 else 1
        return Decision(((4.0 * slow, 0.6),), expose=bool(self.last.asks))


class Rocks(ToAndFro):
    """Pushes and pulls by the same, and exposes every 2 s at least."""

    def decide(self, observation: Observation) -> Decision:
        decision = super().decide(observation)
        slow = -1 if int(observation.time_s / 4) % 2 else 1
        return Decision(((5.0 * slow, 0.6),), expose=decision.expose or observation.time_s % 2 == 0)


class SeesTheLumen(Rocks):
    """The same, where images are searched for a wire within the lumen, whose radius is 0.8 mm at least: less is seen
    of a motion that is not known."""

    def decide(self, observation: Observation) -> Decision:
        if (seen := observation.tip) is not None:
            observation = replace(observation, tip=replace(seen, offset=min(seen.offset, 0.8)))
        return super().decide(observation)


def driven(
    navigation: Navigation, world: World, seed: int = 1, kind: type[ToAndFro] = ToAndFro
) -> Iterator[tuple[ToAndFro, NavigationLoop]]:
    policy = kind()
    loop = NavigationLoop(navigation, policy, seed=seed, world=world)
    while loop.reason is None:
        loop.step()
        yield policy, loop


@pytest.fixture(scope="module")
def along_the_fork(fork, wire) -> Navigation:
    shaped = replace(wire.with_tip(bend_rad=np.deg2rad(45.0), stiffness_factor=1.0), tip_bend_length_mm=4.0)
    return Navigation(anatomy=fork, device=shaped, target=Target(branch=2, abscissa=33.0), seconds=14.0)


def test_a_deeper_ostium_is_noticed_and_identified(along_the_fork) -> None:
    """2.5 mm, to half a millimetre, by at most five images; both bands then hold."""
    found, held = None, list[bool]()
    for policy, loop in driven(along_the_fork, World(ostium_mm=2.5)):
        monitor = policy.monitor
        if found is None and monitor.identified is not None and policy.exposures >= 2:
            found = monitor.belief.ostium_mm @ monitor.belief.weight
            assert policy.exposures <= 5
        if found is not None:
            tip, believed = loop.simulator.project(), policy.last
            off = abs(believed.abscissa - tip.abscissa[0, 0]), abs(believed.offset - tip.offset[0, 0])
            held.append(bool(np.less_equal(off, np.add(believed.half_width, 4.0 * 0.5)).all()))
    assert found == pytest.approx(2.5, abs=0.5)
    assert np.mean(held) > 0.75


class Paced(Rocks):
    """The same, where each decision grants identification little."""

    def start(self, navigation: Navigation, seed: int) -> None:
        super().start(navigation, seed)
        self.monitor = Monitor(navigation, read_agent_calibration("assumed", 1), pace=Pace(600_000))


def test_identification_goes_on_over_decisions_and_its_belief_follows_what_came_meanwhile(along_the_fork) -> None:
    shown, thinks = (0.4, 1.1, -0.9), 0
    for policy, _ in driven(along_the_fork, World(registration_mm=shown), kind=Paced):
        thinks += policy.monitor._thought is not None
        if policy.monitor.identified is not None:
            break
    assert thinks > 1
    belief, past = policy.monitor.belief, policy.monitor.past
    np.testing.assert_allclose(belief.members[0].registered_mm(0.0)[1:], shown[1:], atol=0.5)
    deep_mm = belief.simulator.inserted_length[belief.best, 0] - belief.ostium_mm[belief.best]
    assert deep_mm == pytest.approx(past.proximal[-1][0, 0], abs=0.05)
    assert max(past.exposures) < len(past.proximal) - 1  # what was seen last is some periods ago
    assert policy.monitor.seen is None  # that is not where the tip is now


def test_a_wrong_registration_is_noticed_and_taken_off_what_x_ray_shows(along_the_fork) -> None:
    shown = (0.4, 1.1, -0.9)
    for policy, _ in driven(replace(along_the_fork, seconds=10.0), World(registration_mm=shown), kind=Rocks):
        belief = policy.monitor.belief
    assert policy.monitor.identified is not None and "registered beside" in policy.last.found
    found = belief.members[0].registered_mm(10.0)
    np.testing.assert_allclose(found[1:], shown[1:], atol=0.5)  # x lies along the vessel
    seen = policy.monitor.past.exposures[0]
    off = belief.in_vessel(seen, 0).position - seen.position
    np.testing.assert_allclose(off, -np.array(belief.members[0].registration_mm))


def test_nothing_is_noticed_where_nothing_is_wrong(along_the_fork) -> None:
    for policy, _ in driven(along_the_fork, World()):
        assert not policy.monitor.alarm and policy.monitor.identified is None
    assert 1 <= policy.exposures <= 6


def test_a_play_that_the_encoders_do_not_see_is_noticed_and_identified(along_the_fork) -> None:
    """2.5 mm: tip and band are right after the wire has turned back, and the play is stated."""
    robot = RobotConfig(encoders_at="motor", wire=DriveConfig(play_mm=2.5))
    at = list[float]()
    for policy, loop in driven(replace(along_the_fork, seconds=20.0), World(robot=robot), seed=2, kind=Rocks):
        found = policy.last.found
        at.append(float(loop.simulator.project().abscissa[0, 0]))
    assert policy.monitor.belief.drives.unknown and "the wire is not where its encoder says" in found
    low, high = (float(each) for each in re.search(r"play of (.*) to (.*) mm", found).groups())
    assert low - 0.3 <= 2.5 <= high + 0.3 and high - low < 1.0
    assert policy.last.abscissa == pytest.approx(at[-2], abs=1.0)


def test_a_vessel_that_moves_is_noticed_and_its_motion_identified(along_the_fork) -> None:
    motion = Motion(heart_period_s=0.8, annulus_mm=9.0, breathing_period_s=4.4, breathing_caudal_mm=6.0)
    held = list[bool]()
    for policy, loop in driven(replace(along_the_fork, seconds=18.0), World(motion=motion), kind=Rocks):
        tip, last = loop.simulator.project(), policy.last
        off = abs(last.abscissa - tip.abscissa[0, 0]), abs(last.offset - tip.offset[0, 0])
        if policy.monitor.moves is not None:
            held.append(bool(np.less_equal(off, np.add(last.half_width, 4.0 * 0.5)).all()))
    found = policy.monitor.moves.motion
    assert found.heart_period_s == pytest.approx(0.8, rel=0.02)
    assert found.breathing_period_s == pytest.approx(4.4, rel=0.05)
    assert found.breathing_caudal_mm == pytest.approx(6.0, abs=1.5)
    assert len(held) > 12 and np.mean(held) > 0.85


def test_amplitudes_that_differ_from_the_known_motion_are_identified(along_the_fork) -> None:
    known = Motion()
    motion = replace(known, breathing_caudal_mm=10.0, breathing_anterior_mm=5.0)
    navigation = replace(along_the_fork, seconds=14.0, known_motion=known)
    run = driven(navigation, World(motion=motion), kind=SeesTheLumen)
    *_, (_, at), (policy, _) = [(each, float(loop.simulator.project().abscissa[0, 0])) for each, loop in run]
    found = policy.monitor.moves.motion
    assert found.heart_period_s == pytest.approx(known.heart_period_s)
    assert found.breathing_caudal_mm == pytest.approx(10.0, abs=1.5)
    assert not policy.monitor.lost
    assert policy.last.abscissa == pytest.approx(at, abs=1.0)


def innovations(random: np.random.Generator, off: np.ndarray, sd: np.ndarray, count: int) -> Innovations:
    made = Innovations()
    for _ in range(count):
        made.take(off + sd * random.standard_normal(2), HALF_MM, (0.0, 0.0))
    return made


def test_bands_are_widened_by_as_much_as_innovations_exceed_them() -> None:
    """Covariance matching: of a prediction whose error is three times what its band says, the factor is three."""
    random, noise = np.random.default_rng(0), np.array(ASSUMED_SD_MM)
    as_calibrated = [innovations(random, np.zeros(2), np.hypot(HALF_MM / 1.645, noise), 12) for _ in range(200)]
    assert np.median([made.factor[0] for made in as_calibrated]) < 1.1
    worse = [innovations(random, np.zeros(2), np.hypot(3 * HALF_MM / 1.645, noise), 12) for _ in range(200)]
    assert np.mean([made.factor[0] ** 2 for made in worse]) == pytest.approx(9.0, rel=0.25)
    assert min(made.factor.min() for made in as_calibrated + worse) == 1.0


def test_small_errors_to_one_side_raise_the_alarm_and_two_good_images_end_it() -> None:
    made, taken = Innovations(), 0
    while not made.alarm and taken < 20:
        made.take(np.array([0.95, 0.0]), HALF_MM, (0.0, 0.0))  # each within its bound of 1.1 mm
        taken += 1
    assert 2 <= taken <= 6
    made.take(np.zeros(2), HALF_MM, (0.0, 0.0))
    assert made.alarm
    made.take(np.zeros(2), HALF_MM, (0.0, 0.0))
    assert not made.alarm


def test_where_nothing_explains_the_image_the_band_is_infinite_and_holds_nothing(along_the_fork) -> None:
    (policy, loop), *_ = driven(replace(along_the_fork, seconds=0.5), World())
    seen = loop.observation.tip
    far = replace(seen, position=seen.position + np.array([0.0, 30.0, 0.0]))
    believed = policy.monitor.step(loop.observation.devices, (), far)
    assert policy.monitor.lost and np.isinf(believed.half_width).all()
    record = loop.record()
    assert record.in_bands.all()
    assert not replace(record, half_width=np.full_like(record.half_width, np.inf)).in_bands.any()


def test_the_load_ratio_is_the_one_that_the_forces_have() -> None:
    """Σ read · predicted / Σ predicted², less 0.25; what is weak does not count."""
    loads = LoadRatio()
    assert loads.value == 1.0
    for force_n in np.linspace(0.1, 0.3, 60):
        loads.take(1.5 * force_n, force_n)
    assert loads.value == pytest.approx(1.25, abs=0.02)
    before = loads.value
    loads.take(9.0, 0.01)
    assert loads.value == before
    for _ in range(50):
        loads.take(0.04, 0.2)
    assert loads.value == 1.0  # less force than predicted allows no more


@pytest.mark.parametrize(("speed_mm_s", "ahead_n"), [(5.0, 0.2), (0.4, None), (-5.0, None)])
def test_the_valve_hides_the_force_of_a_drive_that_does_not_advance(speed_mm_s, ahead_n) -> None:
    assert ahead_of_valve_n(((0.26, 0.0),), ((speed_mm_s, 1.0),), (0.05, 0.002)) == pytest.approx(ahead_n)
    assert ahead_of_valve_n((), ((speed_mm_s, 1.0),), (0.05, 0.002)) is None


@pytest.mark.parametrize(
    ("off_n", "sd_n", "times", "outside"),
    [
        (0.1, 0.05, 5, True),
        (-0.1, 0.05, 5, True),
        (0.08, 0.05, 5, False),
        (0.1, np.inf, 5, False),
        (0.1, 0.05, 4, False),
    ],
)
def test_a_drive_pushes_otherwise_where_five_readings_are_outside_the_band_together(
    off_n, sd_n, times, outside
) -> None:
    loads = LoadRatio()
    for _ in range(times):
        loads.take(0.01 + off_n, 0.01, sd_n)
    assert loads.outside == outside
