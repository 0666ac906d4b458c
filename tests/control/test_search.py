"""The search for wire and catheter, straight on where that goes, else a manoeuvre at the fork; and its agent."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from endopilot.belief.belief import Belief, BeliefConfig
from endopilot.control.agent import AgentPolicy
from endopilot.control.agent_config import AgentConfig
from endopilot.control.course import Course, places_of
from endopilot.control.search import Search
from endopilot.control.trials import CATHETER, WIRE
from endopilot.devices.catheter import read_catheter
from endopilot.navigation.loop import LoopConfig, NavigationLoop
from endopilot.navigation.policy import Hand, Observation
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.world import World
from endopilot.tasks.navigation import DECISION_PERIOD_S, Navigation, Target
from endopilot.tasks.route import Route
from endopilot.xray.fluoroscope import TipMeasurement

CORE = SimulatorConfig(element_mm=2.0, time_step_s=0.1, threads=1)
BELIEF = BeliefConfig(members=2, stiffness_levels=1, element_mm=2.0, time_step_s=0.1)


@pytest.fixture(scope="module")
def side_branch(fork, wire) -> Navigation:
    """Return a target in the side branch of a vessel, to which the catheter's tip is to go."""
    side = min(fork.tree.leaves(), key=lambda leaf: fork.tree.branches[leaf].centerline.radius[-1])
    return Navigation(
        anatomy=fork,
        device=wire,
        target=Target(branch=side, abscissa=28.0),
        catheters=(read_catheter("microcatheter-1.7f"),),
        arrives="catheter",
        start_inserted_length_mm=10.0,
        start_rotation_rad=np.pi,
        seconds=60.0,
        force_limit_n=0.3,
    )


def agent_config(navigation: Navigation) -> AgentConfig:
    return replace(AgentConfig.of(navigation), belief=BELIEF)


def search(navigation: Navigation) -> tuple[Search, Belief, Course]:
    """Return a search, the belief that it began with, and what it found."""
    belief = Belief(navigation, [World()], BELIEF)
    route = Route.to(navigation.anatomy, navigation.target)
    one = Search(navigation, route, belief, config=agent_config(navigation).search, seed=0)
    return one, belief, one.find(belief, seconds=navigation.seconds)


@pytest.fixture(scope="module")
def found(side_branch) -> tuple[Belief, Course]:
    """Return a start that looks away from the branch, and a course from there."""
    return search(side_branch)[1:]


def test_a_course_into_a_side_branch_brings_wire_and_catheter_there(side_branch, found) -> None:
    belief, course = found
    assert course.reached == 1.0 and 0 < course.force.max() <= 0.9 * 0.3
    assert belief.simulator.inserted_length[0, 0] == pytest.approx(10.0)  # the start stays as it is
    assert np.abs(course.control[:, 0, 1]).sum() * DECISION_PERIOD_S > 0.5  # it has to turn
    ends = np.flatnonzero(course.exposed)
    assert len(ends) == 2 and ends[-1] == len(course.control) - 1 and np.array_equal(course.checked, course.exposed)
    route = Route.to(side_branch.anatomy, side_branch.target)
    assert not any(route.off_route(course.tip[int(end)]).any() for end in ends)
    assert len(course.control) == len(course.proximal) == len(course.tip.abscissa) == len(course.force)
    assert (np.abs(course.control).sum(axis=(1, 2)) > 0).all()  # without pauses


def test_where_no_manoeuvre_passes_the_search_says_where(side_branch, found) -> None:
    weak = replace(side_branch, force_limit_n=1e-6)
    one, _, course = search(weak)
    assert course.reached == 0.0 and len(course.control) == 0
    assert f"past {one.route.waypoints[0]:.0f} mm" in one.halt


def test_from_the_target_there_is_nowhere_to_go(side_branch) -> None:
    there = replace(side_branch, target=Target(branch=0, abscissa=10.0), arrives="wire")
    one, _, course = search(there)
    assert course.reached == 1.0 and len(course.control) == 0 and one.halt == ""


def test_the_agent_arrives_with_little_xray(side_branch) -> None:
    policy = AgentPolicy(agent_config(side_branch))
    record = NavigationLoop(side_branch, policy, config=LoopConfig(simulator=CORE), seed=2).run()
    assert record.reason == "reached" and record.safe
    assert policy.plans >= 1 and record.exposures < len(record.time_s) / 2
    along, across = policy.believed().half_width
    assert along > 0 and across > 0


def test_a_wire_that_no_simulated_one_explains_is_pulled_back_until_one_does(side_branch) -> None:
    policy = AgentPolicy(agent_config(side_branch))
    policy.start(side_branch, 0)
    believed = policy.belief.simulator.tip_position[0, 0]

    def seen(shift_mm: float, sd_mm: float = 0.0) -> Observation:
        tip = TipMeasurement(believed + np.array([0.0, 0.0, shift_mm]), 10.0 + shift_mm, 0.0, 0, sd_mm**2 * np.eye(3))
        return Observation(0.0, ((10.0, np.pi), (0.0, 0.0)), tip)

    lost = policy.decide(seen(8.0))
    assert lost.devices[0][0] < 0 and lost.devices[1][0] == 0.0 and lost.expose and policy.plans == 0
    inside = policy.decide(replace(seen(8.0), devices=((10.0, np.pi), (12.0, 0.0))))
    assert inside.devices[0][0] < 0 and inside.devices[1][0] < 0
    policy.start(side_branch, 0)
    policy.decide(seen(0.5))
    assert policy.plans == 1 and not policy.monitor.lost
    policy.start(side_branch, 0)
    policy.decide(seen(8.0, sd_mm=4.0))
    assert policy.plans == 1 and not policy.monitor.lost  # a poor image proves little


def test_the_agent_goes_on_after_hands_that_drove_both(side_branch) -> None:
    policy = AgentPolicy(agent_config(side_branch))
    loop = NavigationLoop(side_branch, policy, config=LoopConfig(simulator=CORE), seed=2)
    loop.step()
    loop.hand_over(Hand(((2.0, 1.5), (4.0, 0.0))))
    for _ in range(4):
        loop.step()
    loop.hand_over(None)
    followed = policy.belief.simulator.inserted_length[:, 1] - policy.belief.ostium_mm
    assert loop.observation is not None and followed == pytest.approx(loop.observation.devices[1][0])
    record = loop.run()
    assert record.reason == "reached" and record.safe and record.exposed[5]


@pytest.fixture(scope="module")
def hurried(side_branch) -> Navigation:
    """Return a target straight ahead for which there is little time."""
    return replace(side_branch, target=Target(branch=0, abscissa=18.0), seconds=6.0)


def test_where_there_is_little_time_wire_and_catheter_move_together_and_faster(hurried) -> None:
    config = AgentConfig.of(hurried).search
    assert config.together and config.speed_mm_s == pytest.approx(4 * 18.0 / 6.0)
    assert AgentConfig.of(replace(hurried, seconds=60.0)) is AgentConfig.of(replace(hurried, seconds=70.0))
    slow, fast = (search(replace(hurried, seconds=seconds))[2] for seconds in (60.0, 6.0))
    assert slow.reached == fast.reached == 1.0 and len(fast.control) < 0.75 * len(slow.control)


def test_a_wire_whose_tip_is_to_arrive_is_turned_on_in_a_narrow_lumen(pair) -> None:
    """From a start that looks away from it, the wire does not enter the side branch as it is pushed."""
    _, _, straight = search(pair)
    assert straight.reached == 1.0
    one, _, course = search(replace(pair, target=Target(branch=2, abscissa=30.0), start_rotation_rad=np.pi))
    assert course.reached == 1.0 and one.halt == ""
    assert np.abs(course.control[:, WIRE, 1]).max() > 0


def test_a_catheter_whose_tip_is_to_arrive_comes_along(pair) -> None:
    _, _, course = search(replace(pair, arrives="catheter"))
    assert course.reached == 1.0 and course.control[:, CATHETER, 0].max() > 0


def test_a_course_ends_beyond_its_horizon_and_is_no_failure(pair) -> None:
    late = replace(pair, arrives="catheter", seconds=12.0)
    belief = Belief(late, [World()], BELIEF)
    one = Search(late, Route.to(late.anatomy, late.target), belief, config=AgentConfig.of(late).search, seed=0)
    course = one.find(belief, seconds=30.0, horizon_mm=5.0)
    assert course.reached == 0.0 and one.halt == "" and 11.0 <= course.tip.abscissa[-1, 0] < 34.0
    policy = AgentPolicy(replace(AgentConfig.of(late), belief=BELIEF, horizon_mm=5.0, tries=1))
    record = NavigationLoop(late, policy, config=LoopConfig(simulator=CORE), seed=2).run()
    assert record.reason == "reached" and policy.plans > 1


def test_places_lie_at_forks_and_between_them(fork) -> None:
    route = Route.to(fork, Target(branch=2, abscissa=35.0))
    assert places_of(route, 0.0, alone=True, together=False) == route.waypoints.tolist() == pytest.approx([22.5, 35.0])
    assert places_of(route, 0.0, alone=False, together=False) == pytest.approx([11.25, 22.5, 35.0])
    assert places_of(route, 0.0, alone=False, together=True) == pytest.approx([22.5, 35.0])
    assert places_of(route, 30.0, alone=False, together=False) == pytest.approx([35.0])
