"""One navigation: what the policy is given, what is recorded, and how it ends."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from endopilot.control.navigate import NavigateConfig, set_up_navigation
from endopilot.devices.robot import read_robot
from endopilot.errors import InputError
from endopilot.navigation.loop import LoopConfig, NavigationLoop
from endopilot.navigation.policy import Decision, Hand, Observation, Policy
from endopilot.robot.robot import CYCLE_S
from endopilot.simulation.motion import Motion, motion_named
from endopilot.simulation.world import World
from endopilot.tasks.navigation import Navigation, Target
from endopilot.xray.fluoroscope import FluoroscopeConfig

IDEAL = read_robot("ideal")
PERFECT = replace(IDEAL, wire=replace(IDEAL.wire, max_acceleration_mm_s2=1e9, max_acceleration_rad_s2=1e9))


class Forward:
    """Pushes on, and asks for X-ray at some of its decisions."""

    def __init__(self, speed: float, expose_every: int = 1000, rotation: float = 0.0) -> None:
        self.speed, self.expose_every, self.rotation = speed, expose_every, rotation
        self.given: list[Observation] = []

    def start(self, navigation: Navigation, seed: int) -> None:
        self.navigation = navigation

    def decide(self, observation: Observation) -> Decision:
        self.given.append(observation)
        return Decision(((self.speed, self.rotation),), expose=len(self.given) % self.expose_every == 0)


@pytest.fixture
def straight(fork, wire) -> Navigation:
    return Navigation(anatomy=fork, device=wire, target=Target(branch=1, abscissa=30.0), seconds=10.0)


def test_a_policy_that_pushes_on_reaches_a_target_straight_ahead(straight) -> None:
    policy = Forward(6.0, expose_every=3)
    assert isinstance(policy, Policy)
    record = NavigationLoop(straight, policy, seed=1).run()
    assert record.reason == "reached" and record.success
    assert abs(record.tip.abscissa[-1, 0] - 30.0) <= 2.0 and record.tip.branch[-1, 0] == 1
    assert (np.abs(record.tip.abscissa[:-1, 0] - 30.0) > 2.0).all()  # it ends at once
    samples = len(policy.given)
    assert len(record.time_s) == len(record.inserted_length) == len(record.tip.abscissa) == samples + 1
    assert record.seconds == record.time_s[-1] == 0.5 * samples
    # X-ray is on at the start and where the decision before asked for it; only then is a tip given
    on = [index == 0 or index % 3 == 0 for index in range(samples)]
    assert [observation.tip is not None for observation in policy.given] == on == record.exposed[:-1].tolist()
    assert record.exposures == sum(on)
    for index in np.flatnonzero(record.exposed):
        assert policy.given[index].tip is record.measured[index]
        error = np.linalg.norm(record.measured[index].position - record.tip_position[index, 0])
        assert 0.0 < error < 1.5
    assert record.peak_force_n == record.contact_force_max.max()
    assert record.safe == (record.peak_force_n <= straight.force_limit_n)
    assert 20 < record.path_mm < 40


def test_it_ends_in_time_and_the_same_seed_repeats_it(straight) -> None:
    first, again = (NavigationLoop(straight, Forward(1.0, 2, 0.7), seed=5).run() for _ in range(2))
    other = NavigationLoop(straight, Forward(1.0, 2, 0.7), seed=6).run()
    assert first.reason == "time" and not first.success and first.seconds == 10.0
    np.testing.assert_array_equal(first.tip_position, again.tip_position)
    assert first.measured[2].position.tolist() == again.measured[2].position.tolist()
    assert first.measured[2].position.tolist() != other.measured[2].position.tolist()


def test_encoders_count_from_where_the_ostium_is_believed_to_be(straight) -> None:
    policy = Forward(4.0)
    record = NavigationLoop(straight, policy, config=LoopConfig(robot=PERFECT), world=World(ostium_mm=1.5)).run()
    encoder = np.array([observation.devices[0][0] for observation in policy.given])
    np.testing.assert_allclose(record.inserted_length[:-1, 0] - encoder, 1.5, atol=1e-9)
    np.testing.assert_allclose(np.diff(record.inserted_length[:, 0]), 2.0, atol=1e-6)


def test_a_catheter_that_leans_in_reality_leads_the_wire_elsewhere(straight) -> None:
    truth = World(axis_deg=20.0, axis_side_deg=90.0)
    given, real = straight.anatomy.insertion, truth.anatomy(straight.anatomy).insertion
    assert np.degrees(np.arccos(given.direction @ real.direction)) == pytest.approx(20.0, abs=1e-6)
    world = NavigationLoop(straight, Forward(6.0), world=truth).simulator
    along = world.position[0, -1] - world.position[0, -2]  # the base lies in the catheter
    assert abs(along @ real.direction) == pytest.approx(np.linalg.norm(along), rel=1e-6)


@pytest.mark.parametrize("xray", ["assumed", "images"])
def test_xray_shows_how_the_guiding_catheter_leans_before_the_wire_is_shaped(fork, xray, tmp_path) -> None:
    path = tmp_path / "leaning.yaml"
    World(axis_deg=20.0).write(path)
    config = NavigateConfig(tip="own", world=str(path), xray=xray)
    set_up = set_up_navigation(fork, "0,0,33", policy="forward", config=config)
    seen, real = set_up.navigation.anatomy.insertion.direction, set_up.true_anatomy.insertion.direction
    off_deg = [float(np.degrees(np.arccos(axis @ real))) for axis in (fork.insertion.direction, seen)]
    assert off_deg[0] == pytest.approx(20.0, abs=1e-6)
    if xray == "assumed":
        assert 0.05 < off_deg[1] < 2.0
    else:  # the images show no catheter
        assert off_deg[1] == off_deg[0]


@pytest.mark.parametrize("devices", [5.0, ((5.0,),), None])
def test_what_is_no_pair_for_each_device_is_refused_in_a_line(straight, devices) -> None:
    class Odd(Forward):
        def decide(self, observation: Observation) -> Decision:
            decision = Decision()
            object.__setattr__(decision, "devices", devices)  # tests check types where a user's program does not
            return decision

    with pytest.raises(InputError, match=r"policy: Odd decided devices = .*; give a pair of velocities for each"):
        NavigationLoop(straight, Odd(1.0)).run()


def test_steps_of_the_loop_are_the_navigation_to_the_bit(straight) -> None:
    whole = NavigationLoop(straight, Forward(3.0, 2, 0.7), seed=5).run()
    loop = NavigationLoop(straight, Forward(3.0, 2, 0.7), seed=5)
    while loop.reason is None:  # in the smallest pieces, and asking for more than is left
        loop.begin()
        for _ in range(4):
            loop.advance(CYCLE_S)
        assert not loop.between_periods
        loop.advance(2.0)
    stepped = loop.record()
    assert stepped.reason == whole.reason
    for name in ("tip_position", "contact_force_max", "control", "exposed"):
        np.testing.assert_array_equal(getattr(stepped, name), getattr(whole, name), err_msg=name)
    np.testing.assert_array_equal(stepped.cycles.command, whole.cycles.command)
    assert whole.cycles.command.shape == (1, 10 * (len(whole.time_s) - 1), 1, 2)
    moved = whole.inserted_length[0, 0] + 0.05 * np.cumsum(whole.cycles.command[0, :, 0, 0])[9::10]
    np.testing.assert_allclose(moved, whole.inserted_length[1:, 0], atol=1e-6)
    assert np.array_equal(whole.shape[:, 0], whole.tip_position[:, 0]) and len(whole.shape) == len(whole.time_s)


def test_a_loop_that_is_over_or_within_a_period_takes_no_decision(straight) -> None:
    loop = NavigationLoop(straight, Forward(3.0))
    loop.begin()
    loop.advance(0.2)
    assert loop.time_s == pytest.approx(0.2)
    with pytest.raises(ValueError, match="period is not over"):
        loop.begin()
    loop.advance(0.3)
    loop.stop()
    with pytest.raises(ValueError, match="navigation is over"):
        loop.step()
    record = loop.record()
    assert record.reason == "stopped" and not record.success and record.seconds == 0.5


def test_a_navigation_that_is_over_goes_on_to_another_target_without_a_limit_of_time(straight) -> None:
    hand = Hand(((6.0, 0.0),))
    loop = NavigationLoop(replace(straight, seconds=4.0, target=Target(branch=0, abscissa=12.0)), hand)
    assert loop.run().reason == "reached" and loop.reached and loop.time_s < 4.0
    loop.aim(straight.target)
    loop.go_on()
    hand.devices = ((2.0, 0.0),)
    while loop.time_s < 5.0:
        loop.step()
    assert loop.reason is None and not loop.reached
    hand.devices = ((6.0, 0.0),)
    record = loop.run()
    assert record.success and abs(record.tip.abscissa[-1, 0] - 30.0) <= 2.0 and record.seconds == loop.time_s
    with pytest.raises(InputError, match="abscissa"):
        loop.aim(Target(branch=0, abscissa=1e3))


def test_a_cycle_of_the_drives_divides_the_time_between_two_decisions(straight) -> None:
    with pytest.raises(InputError, match=r"cycle_s: 0\.03; give what divides 0\.5 s"):
        LoopConfig(cycle_s=0.03)
    ends = {}
    for cycle_s in (CYCLE_S, 0.0125):
        record = NavigationLoop(straight, Forward(3.0), config=LoopConfig(robot=PERFECT, cycle_s=cycle_s), seed=1).run()
        assert record.cycles.command.shape[1] == record.seconds / cycle_s
        ends[cycle_s] = record.tip_position[-1]
    np.testing.assert_allclose(ends[CYCLE_S], ends[0.0125], atol=0.05)


class Watching(Forward):
    """Counts what it sees while somebody else drives."""

    def watch(self, observation: Observation) -> None:
        self.watched = [*getattr(self, "watched", []), observation]


def test_hands_take_over_and_hand_back(straight) -> None:
    policy = Watching(4.0)
    loop = NavigationLoop(straight, policy, config=LoopConfig(robot=PERFECT))
    loop.step()
    loop.hand_over(Hand(((-1.0, 1.0),)))
    for _ in range(3):
        loop.step()
    loop.exposed()
    assert len(policy.given) == 1 and len(policy.watched) == 3
    loop.hand_over(None)
    loop.step()
    assert policy.given[1].tip is not None, "X-ray is on where the policy goes on"
    record = loop.record()
    np.testing.assert_allclose(record.control[:5, 0, 0], [4.0, -1.0, -1.0, -1.0, 4.0])
    np.testing.assert_allclose(np.diff(record.inserted_length[:, 0]), [2.0, -0.5, -0.5, -0.5, 2.0], atol=1e-6)
    assert record.exposed.tolist() == [True, False, False, True, True, False]
    assert record.exposures == 3
    assert record.believed is None and record.half_width is None


def test_an_image_without_a_wire_is_taken_again_and_counts(straight, monkeypatch) -> None:
    loop = NavigationLoop(straight, Forward(4.0))
    blind = iter([True, True, False])
    expose = loop.c_arm.expose
    monkeypatch.setattr(loop.c_arm, "expose", lambda *all, **named: None if next(blind) else expose(*all, **named))
    for _ in range(5):
        loop.step()
    record = loop.record()
    assert record.exposed.tolist() == [True, True, True, False, False, False]
    assert record.exposures == 3
    assert [tip is not None for tip in record.measured] == [False, False, True, False, False, False]


def breathing(**changed: float) -> Motion:
    """Return a breath that shifts the vessel and does not turn it."""
    still = {"annulus_mm": 0.0, "heart_volume_share": 0.0, "heart_rotation_deg": 0.0}
    turned = {"breathing_dorsal_deg": 0.0, "breathing_dextral_deg": 0.0}
    return Motion(**(still | turned | {"breathing_caudal_mm": 6.0, "breathing_anterior_mm": 0.0} | changed))


def test_an_exposure_shows_a_moving_vessel_where_it_is_less_what_the_c_arm_knows(straight) -> None:
    """The ostium's axis is z: a breath of 6 mm towards the feet, sin⁴(πt/4 s), moves the tip by so much along it."""
    sharp = FluoroscopeConfig(pixel_sd=1e-3, along_sd=1e-3)
    config = LoopConfig(robot=PERFECT, fluoroscope=sharp, motion=breathing())

    def errors(known: Motion | None) -> np.ndarray:
        record = NavigationLoop(
            replace(straight, known_motion=known), Forward(3.0, expose_every=1), config=config
        ).run()
        shown = [tip for tip in record.measured if tip is not None]
        return np.array([tip.position for tip in shown]) - record.tip_position[: len(shown), 0]

    unknown, half, exact = (errors(known) for known in (None, breathing(breathing_caudal_mm=3.0), breathing()))
    time_s = 0.5 * np.arange(len(unknown))
    shift = -6.0 * np.sin(np.pi * time_s / 4.0) ** 4
    seen = slice(8, None)  # deep enough in the vessel to be seen in it
    np.testing.assert_allclose(unknown[seen, 2], shift[seen], atol=0.3)
    np.testing.assert_allclose(half[seen, 2], 0.5 * shift[seen], atol=0.3)
    assert np.abs(exact).max() < 0.05
    assert np.abs(unknown[seen, 2]).max() > 4.0


def test_images_show_a_moving_vessel_where_it_is_less_what_is_known(straight) -> None:
    """A breath of 6 mm, of which 5 mm are known, moves the tip by 1 mm along the vessel's axis, z, when inspired."""
    known = replace(straight, known_motion=breathing(breathing_caudal_mm=5.0))
    config = LoopConfig(robot=PERFECT, xray="images", motion=breathing())
    record = NavigationLoop(replace(known, seconds=4.0), Forward(6.0, expose_every=2), config=config, seed=2).run()
    assert all(min(tip.tip_sd_mm) > 0 for tip in record.measured if tip is not None)
    at = np.flatnonzero([tip is not None and k >= 2 for k, tip in enumerate(record.measured)])
    assert len(at) >= 3
    seen = np.array([record.measured[k].position[2] for k in at])
    shift = -(np.sin(np.pi * 0.5 * at / 4.0) ** 4)
    np.testing.assert_allclose(seen - record.tip_position[at, 0, 2], shift, atol=0.4)
    assert np.ptp(shift) > 0.7


def test_a_run_of_contrast_before_the_wire_shows_how_the_patient_moves(straight) -> None:
    """The patient breathes by 7 mm, which the navigation takes to be 4.9 at first."""
    deep, mean = breathing(breathing_caudal_mm=7.0), breathing(breathing_caudal_mm=4.9)
    navigation = replace(straight, known_motion=mean, seconds=1.0)
    config = LoopConfig(robot=PERFECT, xray="images", motion=deep, measure_motion=True)
    loop = NavigationLoop(navigation, Forward(6.0, expose_every=2), config=config, seed=2)
    assert loop.navigation.known_motion.breathing_caudal_mm == pytest.approx(7.0, abs=0.3)
    assert loop.c_arm.known_motion == loop.navigation.known_motion
    with pytest.raises(InputError, match="measure_motion: exposures of assumed errors show no contrast"):
        NavigationLoop(navigation, Forward(6.0), config=replace(config, xray="assumed"), seed=2)


def test_what_is_known_of_the_motion_stands_in_the_navigation(fork) -> None:
    moving, own = NavigateConfig(tip="own", motion="both", motion_seed=3), motion_named("both", 3)
    for known, wanted in (("nothing", None), ("published", Motion()), ("exact", own), ("measured", Motion())):
        config = replace(moving, motion_known=known, xray="images" if known == "measured" else "assumed")
        set_up = set_up_navigation(fork, "0,0,33", config=config)
        assert set_up.motion == own and set_up.navigation.known_motion == wanted
    with pytest.raises(InputError, match="motion_known: measured; only X-ray images measure it"):
        set_up_navigation(fork, "0,0,33", config=replace(moving, motion_known="measured"))
    at_rest = set_up_navigation(fork, "0,0,33", config=NavigateConfig(tip="own"))
    assert at_rest.motion is None and at_rest.navigation.known_motion is None
