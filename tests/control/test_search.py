"""The search for wire and catheter, straight on where that goes, else a manoeuvre at the fork; and its agent."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from endopilot.belief.belief import Belief, BeliefConfig
from endopilot.control.agent import AgentPolicy, OpenLoopPolicy, OraclePolicy
from endopilot.control.agent_config import AgentConfig
from endopilot.control.course import Course
from endopilot.control.push import Push, Pushed
from endopilot.control.search import Search
from endopilot.control.search_config import ManoeuvreConfig
from endopilot.control.together import STRAIGHT, Grid, Together
from endopilot.control.trials import CATHETER, WIRE, Move
from endopilot.devices.catheter import read_catheter
from endopilot.errors import InputError
from endopilot.ladder.attempt import Recording, attempt, repeat
from endopilot.navigation.loop import LoopConfig, NavigationLoop
from endopilot.navigation.policy import Hand, Observation
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.simulator import Simulator
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


def agent_config(navigation: Navigation, turns: int = 4) -> AgentConfig:
    own = AgentConfig.of(navigation)
    return replace(own, search=replace(own.search, manoeuvres=ManoeuvreConfig(turns=turns)), belief=BELIEF)


def search(navigation: Navigation, turns: int = 4) -> tuple[Search, Belief, Course]:
    """Return a search, the belief that it began with, and what it found."""
    belief = Belief(navigation, [World()], BELIEF)
    route = Route.to(navigation.anatomy, navigation.target)
    one = Search(navigation, route, belief, config=agent_config(navigation, turns).search, seed=0)
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


def test_the_controls_of_a_course_lead_where_it_says(side_branch, found) -> None:
    belief, course = found
    like = belief.simulator
    again = Simulator(side_branch.anatomy, side_branch.stack, config=like.config, sharing=[like])
    again.copy_worlds([0], of=like)
    for k, control in enumerate(course.control):
        for _ in range(5):  # as `drive_period` does
            again.step(control[None], DECISION_PERIOD_S / 5)
        assert np.array_equal(again.proximal[0], course.proximal[k])
        assert again.project().abscissa[0, 0] == course.tip.abscissa[k, 0]
    assert side_branch.reached(again.project())[0]


def test_a_wire_that_leads_by_little_ends_little_beyond_the_target(side_branch, monkeypatch) -> None:
    monkeypatch.setattr("endopilot.control.together._LEADS_MM", (3.0,))
    _, _, course = search(side_branch)
    assert course.reached == 1.0
    assert course.tip.abscissa[-1, 0] - side_branch.target.abscissa == pytest.approx(3.0, abs=2.0)


def test_where_no_manoeuvre_passes_the_search_says_where(side_branch, found) -> None:
    weak = replace(side_branch, force_limit_n=1e-6)
    one, _, course = search(weak, turns=1)
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
    assert policy.decide(seen(0.5)).devices[0][0] >= 0 and policy.plans == 1
    policy.start(side_branch, 0)
    assert policy.decide(seen(8.0, sd_mm=4.0)).devices[0][0] >= 0 and policy.plans == 1  # a poor image proves little


def test_the_oracle_looks_always_and_a_plan_is_followed_without_a_look(side_branch) -> None:
    truth, config = World(friction_factor=1.2, ostium_mm=0.5), agent_config(side_branch)
    record = NavigationLoop(
        side_branch, OraclePolicy(truth, config), config=LoopConfig(simulator=CORE), world=truth
    ).run()
    assert record.reason == "reached" and record.safe and record.exposures == len(record.time_s) - 1
    near = replace(side_branch, target=Target(branch=0, abscissa=16.0))
    record = NavigationLoop(near, OpenLoopPolicy(config=config), config=LoopConfig(simulator=CORE)).run()
    assert record.reason == "reached" and record.exposures == 1


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
    while loop.reason is None:
        loop.step()
    record = loop.record()
    assert record.reason == "reached" and record.safe and record.exposed[5]


def test_a_ladder_counts_the_events_that_the_agent_misses(side_branch) -> None:
    beside = replace(side_branch, target=Target(branch=0, abscissa=16.0), start_inserted_length_mm=14.0)
    result = attempt("agent", beside, seed=1)
    events, missed = result["events"]
    assert result["success"] and 0 <= missed <= events
    assert repeat(Recording.unpacked(result["recording"], devices=2), beside, seed=1)["events"] == result["events"]


def test_the_agent_drives_one_catheter(side_branch) -> None:
    outer = read_catheter("straight-5f")
    wide = replace(outer, diameter_mm=1.25)
    with pytest.raises(InputError, match="catheter: 2; the search drives one"):
        NavigationLoop(replace(side_branch, catheters=(*side_branch.catheters, wide)), "agent").run()


def test_of_manoeuvres_that_pass_alike_the_cheapest_is_taken(side_branch, found, monkeypatch) -> None:
    """Where the hardest is called the cheapest, the course presses harder."""
    _, course = found
    monkeypatch.setattr(Search, "manoeuvre_cost", lambda _, pushed: -pushed.force)
    _, _, harder = search(side_branch)
    assert harder.reached == 1.0 and harder.force.max() > course.force.max()


@pytest.fixture(scope="module")
def hurried(side_branch) -> tuple[Navigation, AgentConfig]:
    """Return a target straight ahead, and the settings of an agent that has little time for it."""
    straight = replace(side_branch, target=Target(branch=0, abscissa=18.0))
    assert AgentConfig.of(straight) is AgentConfig.of(side_branch)  # there is time for 4 x 18 mm at 5 mm/s
    return straight, AgentConfig.of(replace(straight, seconds=6.0))


def search_straight(navigation: Navigation, config: AgentConfig) -> Course:
    belief = Belief(navigation, [World()], BELIEF)
    route = Route.to(navigation.anatomy, navigation.target)
    return Search(navigation, route, belief, config=config.search, seed=0).find(belief, seconds=60.0)


def test_where_there_is_little_time_wire_and_catheter_move_together_and_faster(hurried, monkeypatch) -> None:
    monkeypatch.setattr("endopilot.control.together._LEADS_MM", (2.0,))
    straight, config = hurried
    assert config.search.manoeuvres.together and config.search.speed_mm_s == pytest.approx(4 * 18.0 / 6.0)
    slow, fast = (search_straight(straight, each) for each in (agent_config(straight), config))
    assert slow.reached == fast.reached == 1.0 and len(fast.control) < 0.75 * len(slow.control)
    both = [(np.abs(course.control[:, :, 0]) > 0.5).all(axis=1).any() for course in (slow, fast)]
    assert both == [False, True]


def test_where_there_is_little_time_slow_trials_are_given_up(hurried, monkeypatch) -> None:
    monkeypatch.setattr("endopilot.control.together._LEADS_MM", (2.0, 1000.0))
    monkeypatch.setattr("endopilot.control.push._LATE", 1)
    straight, config = hurried
    pushes, run = [], Push.run
    monkeypatch.setattr(Push, "run", lambda *given: pushes.append(run(*given)) or pushes[-1])
    assert search_straight(straight, config).reached == 1.0
    assert [push.passed.tolist() for push in pushes] == [[True, False]] and pushes[0].halt[1] == "late"


def test_where_there_is_little_time_loops_are_the_last_resort(hurried, monkeypatch) -> None:
    straight, config = hurried
    tried, push_on = [], Search._try

    def nothing_passes(search: Search, grid: Grid, waypoint: float) -> Pushed:
        if grid == STRAIGHT:
            return push_on(search, grid, waypoint)
        tried.append(grid)
        many = search._many.count
        none = np.zeros(many)
        return Pushed([], none.astype(int), none > 0, none, none, none, ["off"] * many)

    monkeypatch.setattr(Search, "_try", nothing_passes)
    monkeypatch.setattr(Together, "bring_on", lambda *_: False)
    assert search_straight(straight, config).reached == 1.0 and not tried
    monkeypatch.setattr("endopilot.control.search.LOOPS_MM", -1000.0)
    assert search_straight(straight, config).reached == 1.0 and tried


@pytest.mark.parametrize(("stays_mm", "slack_mm"), [(10.0, 8.0), (30.0, 30.0)])
def test_where_there_is_little_time_slack_is_pulled_out_unless_the_tip_leaves(
    hurried, monkeypatch, stays_mm, slack_mm
) -> None:
    """The tip lies 30 mm behind what is inserted; it stays until so much is left, and then comes along twice as far."""
    straight, config = hurried
    belief = Belief(straight, [World()], BELIEF)
    one = Search(straight, Route.to(straight.anatomy, straight.target), belief, config=config.search, seed=0)
    course = one._course
    course.put(np.array([0]), belief.simulator, np.ones(1))
    course.move(course.control(Move(WIRE, 30.0), Move(CATHETER, 50.0)))
    inserted = float(course.lengths.max())

    def here(_: Together) -> float:
        pulled = inserted - float(course.lengths.max())
        return inserted - 30.0 - 20.0 * max(pulled - (30.0 - stays_mm), 0.0)

    monkeypatch.setattr(Together, "here", property(here))
    one._together.pull_taut(waypoint=5.0)
    assert one._together.slack_mm == pytest.approx(slack_mm, abs=config.search.speed_mm_s * DECISION_PERIOD_S)
    assert (len(course.rows) == 1) == (stays_mm == 30.0)
