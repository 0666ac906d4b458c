"""The policies that plan in the rod core: how they arrive, look, lose the wire, give up, and what they then propose."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from endopilot.belief.bands import AdviserConfig, Calibration
from endopilot.belief.watch import MISMATCH
from endopilot.control.agent import AgentPolicy, OpenLoopPolicy, OraclePolicy
from endopilot.control.agent_config import CALIBRATIONS, read_agent_calibration
from endopilot.control.course import Course
from endopilot.control.navigate import NavigateConfig, navigate, propose_devices
from endopilot.control.outcome import decision_times, tell_outcome
from endopilot.devices.robot import RobotConfig
from endopilot.errors import InputError
from endopilot.navigation.loop import LoopConfig, NavigationLoop
from endopilot.navigation.policy import Decision, Hand, Observation, Policy
from endopilot.simulation.world import World
from endopilot.tasks.navigation import Target
from endopilot.tasks.targets import find_target
from endopilot.types import TipProjection
from toy_belief import QUICK, measured


@pytest.fixture
def policy(side_branch) -> AgentPolicy:
    """Return an agent that has begun a navigation into the side branch."""
    begun = AgentPolicy(QUICK)
    begun.start(side_branch, 0)
    return begun


def test_the_oracle_gets_into_a_side_branch_that_pushing_misses(side_branch) -> None:
    failed = NavigationLoop(replace(side_branch, seconds=8.0), "forward", seed=1).run()
    assert not failed.success
    policy = OraclePolicy(config=QUICK)
    assert isinstance(policy, Policy)
    record = NavigationLoop(side_branch, policy, seed=1).run()
    assert record.success and record.safe and record.faults == 0
    assert record.tip.branch[-1, 0] == 2
    assert record.exposures == len(record.time_s) - 1  # X-ray is always on


def test_the_oracle_knows_a_catheter_that_leans(side_branch) -> None:
    truth = World(axis_deg=20.0, axis_side_deg=90.0)
    policy = OraclePolicy(truth, config=QUICK)
    policy.start(side_branch, seed=1)
    nodes = policy.belief.simulator.position[0]
    along = nodes[-1] - nodes[-2]  # the base lies in the catheter
    axis = truth.anatomy(side_branch.anatomy).insertion.direction
    assert abs(along @ axis) == pytest.approx(np.linalg.norm(along), rel=1e-6)


def test_the_agent_takes_no_more_exposures_than_it_may(side_branch) -> None:
    truth = World(ostium_mm=2.5)  # images disagree with its belief
    record = NavigationLoop(side_branch, AgentPolicy(replace(QUICK, most_exposures=2)), seed=2, world=truth).run()
    assert record.exposures == 2 and record.reason == "gave up"
    assert record.gives_up == "2 exposures did not suffice; AgentConfig.most_exposures allows more"


def test_the_agent_arrives_though_the_wire_is_another_than_believed(side_branch) -> None:
    truth = World(friction_factor=1.2, tip_stiffness_factor=0.8, ostium_mm=0.3)
    record = NavigationLoop(side_branch, AgentPolicy(QUICK), seed=2, world=truth).run()
    assert record.success and record.safe and record.faults == 0
    assert 1 <= record.exposures < (len(record.time_s) - 1) / 2  # it looks seldom
    held, half = record.in_bands, record.half_width
    assert half is not None and len(held) == np.isfinite(half).all(axis=1).sum() > len(record.time_s) / 2
    assert held.mean() > 0.5
    assert (
        replace(record, half_width=half + 1e3).in_bands.all()
        and not replace(record, half_width=0 * half).in_bands.any()
    )
    assert len(replace(record, half_width=None).in_bands) == 0


def test_the_agent_arrives_though_encoders_sit_in_front_of_a_wide_play(side_branch, with_play) -> None:
    runs = [
        NavigationLoop(side_branch, AgentPolicy(QUICK), config=LoopConfig(robot=with_play), seed=seed).run()
        for seed in (4, 5, 6)
    ]
    assert all(each.success and each.safe and each.faults == 0 for each in runs)
    assert sum(each.exposures for each in runs) <= 3 * 13  # exposures may follow each other after 1 s


def test_without_play_what_is_known_of_the_robot_changes_nothing(side_branch) -> None:
    told, untold = (
        NavigationLoop(replace(side_branch, robot=known), AgentPolicy(QUICK), seed=2).run()
        for known in (RobotConfig(), None)
    )
    assert np.array_equal(told.tip_position, untold.tip_position) and np.array_equal(told.control, untold.control)


def test_the_first_decision_goes_by_the_first_reading(policy) -> None:
    (velocity,) = policy.decide(Observation(0.0, ((2.3, 0.1),), None)).devices
    assert policy._follower.course is not None
    assert velocity == tuple(((policy._follower.course.proximal[0, 0] - [2.3, 0.1]) / 0.5).tolist())


def goes_on(decision: Decision) -> bool:
    speed, turn = decision.devices[0]
    return speed > -1e-9 and max(speed, abs(turn)) > 1e-9  # turned or pushed, and not pulled back


def test_a_tip_that_no_wire_explains_is_pulled_back_under_xray(policy) -> None:
    shown = measured(policy.belief, 0)
    assert goes_on(policy.decide(Observation(0.0, ((2.0, 0.0),), shown)))
    far = replace(shown, position=shown.position + np.array([6.0, 0.0, 5.0]))
    lost = policy.decide(Observation(0.5, ((2.0, 0.0),), far))
    assert lost.devices[0][0] < 0 and lost.expose
    policy.decide(Observation(1.0, ((2.0, 0.0),), measured(policy.belief, 0)))
    assert policy.plans == 2  # found again, it searches another path


def test_devices_rest_for_three_seconds_while_an_explanation_is_sought_and_are_then_pulled_back(side_branch) -> None:
    policy = AgentPolicy(replace(QUICK, decision_evaluations=1))  # none is found
    policy.start(side_branch, 0)
    far = replace(measured(policy.belief, 0), position=np.full(3, 50.0))
    done = [policy.decide(Observation(0.5 * k, ((6.0, 0.0),), far if k == 1 else None)) for k in range(9)][1:]
    assert [each.devices[0][0] < 0 for each in done] == [each.expose for each in done] == [*[False] * 6, True, True]
    assert policy.monitor.thinks and not any(each.gives_up for each in done)


def test_a_wire_that_is_lost_again_and_again_ends_with_the_cause(policy) -> None:
    said = ""
    policy.monitor.changes_left = 0  # nothing else is sought
    for k in range(4):
        shown = measured(policy.belief, int(np.argmax(policy.belief.weight)))
        far = replace(shown, position=shown.position + np.array([6.0, 0.0, 5.0]))
        assert not said
        said = policy.decide(Observation(1.0 * k, ((4.0, 0.0),), far)).gives_up
        shown = measured(policy.belief, int(np.argmax(policy.belief.weight)))
        policy.decide(Observation(1.0 * k + 0.5, ((4.0, 0.0),), shown))
    assert "lost 4 times: no wire, lumen or ostium explains what X-ray shows" in said


def test_a_wire_that_is_out_and_still_seen_ends_the_navigation(policy) -> None:
    far = replace(measured(policy.belief, 0), position=np.full(3, 50.0))
    said = [policy.decide(Observation(0.5 * k, ((mm, 0.0),), far)).gives_up for k, mm in enumerate((4.0, 2.0, 0.0))]
    assert said[:2] == ["", ""] and said[2].startswith("pulled out, the wire is still seen: no wire")


def test_a_lost_wire_that_is_back_in_its_catheter_unseen_sets_out_again(policy) -> None:
    far = replace(measured(policy.belief, 0), position=np.full(3, 50.0))
    assert policy.decide(Observation(0.0, ((6.0, 0.0),), far)).devices[0][0] < 0
    assert policy.decide(Observation(0.5, ((4.0, 0.0),), None)).devices[0][0] < 0  # not there yet
    again = policy.decide(Observation(1.0, ((1.9, 0.0),), None))
    assert goes_on(again) and not policy.monitor.lost
    assert again.expose and policy.believed().asks == MISMATCH  # which has yet to be explained


def test_a_tip_that_is_measured_badly_is_not_lost(side_branch) -> None:
    """6 mm are more than `lost_along_mm` and `lost_across_mm`, and less than three standard deviations of 2.5 mm."""
    for sd_mm, lost in ((0.0, True), (1.0, True), (2.5, False)):
        policy = AgentPolicy(QUICK)
        policy.start(side_branch, 0)
        shown = measured(policy.belief, int(np.argmax(policy.belief.weight)))
        aside = np.cross(side_branch.anatomy.insertion.direction, [1.0, 0.0, 0.0])
        off = replace(
            shown, position=shown.position + 6.0 * aside / np.linalg.norm(aside), covariance=sd_mm**2 * np.eye(3)
        )
        assert (policy.decide(Observation(0.0, ((2.0, 0.0),), off)).devices[0][0] < 0) == lost


def test_with_a_calibration_the_adviser_says_when_to_look(side_branch) -> None:
    """A band of Δtip that widens by 0.5 mm a second is 1 mm wide after 2 s: X-ray every fourth period."""
    calibration = Calibration(
        level=0.9, scale=1.0, abscissa_terms=(0.0, 0.51, 0.0, 0.0), offset_terms=(0.0, 0.0, 0.0, 0.0), anatomies=9,
        intervals=9, dataset="", onset=0.1, longest_s=45.0,
    )  # fmt: skip
    policy = AgentPolicy(QUICK, calibration=calibration, advice=AdviserConfig(abscissa_mm=1.0, wall_ratio=2.0))
    policy.start(replace(side_branch, target=Target(branch=1, abscissa=39.0)), 0)
    at = [k for k in range(9) if policy.decide(Observation(0.5 * k, ((2.0 + k, 0.0),), None)).expose]
    assert at == [3, 7]


def test_the_package_s_calibrations_are_of_the_agent_s_wires_and_of_each_kind_of_xray(side_branch) -> None:
    """Surer than nothing, and of enough patients for their level."""
    found = [read_agent_calibration(*each) for each in CALIBRATIONS]
    assert all(each.level == 0.9 and each.anatomies >= 9 for each in found)
    assert found[0] != found[1] != found[2] != found[0]
    half = found[0].half_width(np.array([5.0]), np.array([20.0]), np.array([[0.5, 0.1]]))
    assert 0.5 < half[0, 0] < 5.0 and 0.05 < half[0, 1] < 1.0
    with pytest.raises(InputError, match="not calibrated for xray: images with 1 catheters"):
        read_agent_calibration("images", 2)


def test_open_loop_plans_once_and_looks_no_more(side_branch) -> None:
    policy = OpenLoopPolicy(config=QUICK)
    record = NavigationLoop(side_branch, policy, seed=1).run()
    assert record.success and record.exposures == 1 and policy.plans == 1
    policy.start(side_branch, 0)
    far = replace(measured(policy.belief, 0), position=np.full(3, 50.0))
    assert goes_on(policy.decide(Observation(0.0, ((2.0, 0.0),), far)))  # whatever the first exposure shows


def test_an_agent_tells_what_it_believes_and_goes_on_after_hands(side_branch) -> None:
    loop = NavigationLoop(side_branch, AgentPolicy(QUICK), seed=2)
    for _ in range(4):
        loop.step()
    loop.hand_over(Hand(((-2.0, 1.5),)))  # away from its course, turned
    for _ in range(6):
        loop.step()
    loop.hand_over(None)
    wires, tip = loop.policy.believed_wires(), loop.policy.belief.tip
    assert wires.shape == (QUICK.belief.members, loop.policy.belief.simulator.nodes, 3)
    likeliest = int(np.argmax(loop.policy.belief.weight))
    np.testing.assert_array_equal(wires[0], loop.policy.belief.simulator.position[likeliest])
    assert loop.believed.abscissa == tip.abscissa[likeliest]
    record = loop.run()
    assert record.success and record.safe
    assert record.exposed[10], "the policy goes on with an image"
    ends = np.abs(record.believed[:-1, 0] - record.tip.abscissa[:-1, 0])
    assert np.isnan(record.believed[-1]).all() and np.median(ends) < 0.5
    bands = record.half_width[:-1][~np.isnan(record.half_width[:-1, 0])]
    assert len(bands) > 5 and (bands > 0).all()


def nowhere_to_go() -> Course:
    """Return the course of a wire that lies at its target."""
    none, tip = np.zeros((0, 1, 2)), np.zeros((0, 1))
    tips, no = TipProjection(tip, tip, tip.astype(int), tip), np.zeros(0, dtype=bool)
    return Course(control=none, proximal=none, tip=tips, force=tip, checked=no, exposed=no, reached=1.0)


def test_a_wire_that_should_have_arrived_goes_by_the_image(side_branch, policy) -> None:
    """No simulated wire says why the target is not reached: X-ray shows how far it is off."""
    shown, here = measured(policy.belief, 0), float(policy.belief.tip.abscissa[0])
    for off_mm, translation in ((0.4, 0.8), (-0.4, -0.8), (1.9, 2.0)):  # at most 2 mm/s
        navigation = replace(side_branch, target=Target(branch=0, abscissa=here + off_mm))
        policy.start(navigation, 0)
        policy._search.go_on = lambda _: nowhere_to_go()
        blind = policy.decide(Observation(0.0, ((2.0, 0.0),), None))
        assert blind.expose and blind.devices[0][0] == 0.0
        assert policy.believed().asks == "the tip should be at the target"
        seen = policy.decide(Observation(0.5, ((2.0, 0.0),), shown))
        assert seen.expose and seen.devices[0] == pytest.approx((translation, 0.0))


def test_a_wire_beside_its_target_gets_another_course(side_branch, policy) -> None:
    """A second rule of a task asks for more than the right place along the vessel."""
    shown, here = measured(policy.belief, 0), float(policy.belief.tip.abscissa[0])
    for near_mm, goes_on in ((None, False), (0.01, True)):
        policy.start(replace(side_branch, target=Target(branch=0, abscissa=here, near_mm=near_mm)), 0)
        policy._search.go_on = lambda _: nowhere_to_go()
        policy.decide(Observation(0.0, ((2.0, 0.0),), None))
        policy.decide(Observation(0.5, ((2.0, 0.0),), shown))
        assert (policy._follower.course is None) == goes_on


def test_a_course_is_searched_again_where_the_drive_pushes_harder_than_simulated(side_branch) -> None:
    """Walls press harder by as much as the drive pushes harder: a fourth of the limit leaves no way, as above."""
    policy = AgentPolicy(config=QUICK)
    policy.start(side_branch, seed=1)
    limited = replace(side_branch, force_limit_n=1.2 * float(policy.find_course(20.0).force.max()))
    policy.start(limited, seed=1)

    def decide(period: int) -> Decision:
        return policy.decide(Observation(0.5 * period, ((side_branch.start_inserted_length_mm, 0.0),), None))

    decide(0)
    first = policy._follower.course
    assert first is not None and first.reached == 1
    for _ in range(50):  # four times the force, and what prior and margin take
        policy.monitor._loads.take(0.86, 0.2)
    assert policy.monitor.load_ratio == pytest.approx(4.0, abs=0.05)
    policy._failed, plans = policy.config.tries, policy.plans  # failed searches are forgotten
    decide(1)
    assert policy.plans == plans + 1
    again = policy._follower.course
    assert again is not None and again.reached == 0 and 3.95 * again.force.max(initial=0.0) <= limited.force_limit_n
    said = next(words for period in range(2, 60) if (words := decide(period).gives_up))
    assert re.search(r"cannot go on .* N is given, and the drive pushes 4\.\d times as hard", said)


def test_a_tip_that_enters_the_fork_is_named_and_nothing_where_nothing_does(side_branch) -> None:
    straight = replace(side_branch.device, tip_bend_rad=0.0, tip_bend_length_mm=0.0)
    given = replace(side_branch, device=straight)
    assert propose_devices(given).startswith(f"{straight.name} with a tip of ")
    assert propose_devices(replace(given, force_limit_n=1e-4), seconds=1e-6) == ""


def test_an_agent_gives_up_early_the_outcome_names_the_fork_and_each_decision_is_timed(side_branch) -> None:
    """A straight tip cannot be shaped by hand here, so the target behind the fork is given up."""
    straight = replace(side_branch.device, tip_bend_rad=0.0, tip_bend_length_mm=0.0)
    point = ",".join(f"{each:.2f}" for each in side_branch.target.position(side_branch.anatomy))
    assert find_target(side_branch.anatomy.tree, point).branch == 2
    policy = AgentPolicy(replace(QUICK, tries=2))
    found = navigate(side_branch.anatomy, point, policy=policy, device=straight, config=NavigateConfig(tip="own"))
    record = found.record
    assert record.reason == "gave up" and not record.success and record.seconds < 0.5 * found.set_up.navigation.seconds
    assert "at the fork into section vessel (branch 2) at 20.0 mm" in record.gives_up
    assert "tip of 0/0 does not enter" in record.gives_up and "--tip" in record.gives_up
    assert found.proposal and f"in a search {found.proposal} reaches it" in tell_outcome(found)
    times = decision_times(found)
    assert len(found.decision_s) == len(record.time_s) - 1 and (found.decision_s > 0).all()
    assert times["median"] <= times["p99"] <= times["longest"] == round(float(np.max(found.decision_s)), 3)
