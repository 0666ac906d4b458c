"""A wire alone in a wide lumen, such as an aorta: what the agent holds possible, tries and waits for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from endopilot.anatomy.extract import extract_anatomy
from endopilot.belief.belief import Belief, BeliefConfig
from endopilot.control.agent import AgentPolicy
from endopilot.control.agent_config import IN_WIDE_LUMEN, AgentConfig
from endopilot.control.push import Pushed
from endopilot.control.search import Search
from endopilot.control.search_config import SearchConfig
from endopilot.control.together import Repertoire
from endopilot.control.trials import WIRE, Move, Period, Trials
from endopilot.devices.catheter import read_catheter
from endopilot.devices.device import read_wire
from endopilot.devices.drive_limits import DriveLimits, far_end_mm
from endopilot.simulation.world import World
from endopilot.tasks.navigation import DECISION_PERIOD_S, Navigation, Target
from endopilot.tasks.route import Route
from endopilot.vessels.sources import Polylines


@pytest.fixture(scope="module")
def aorta() -> Navigation:
    """Return a navigation along a straight vessel that is 24 mm wide."""
    line = np.linspace([0.0, 0, 0], [0, 0, 80], 81)
    anatomy = extract_anatomy(Polylines((line,), (np.full(81, 12.0),)), name="aorta")
    target, wire = Target(branch=0, abscissa=50.0), read_wire("j-035")
    return Navigation(anatomy=anatomy, target=target, device=wire, start_inserted_length_mm=20.0)


@pytest.fixture(scope="module")
def started(aorta) -> AgentPolicy:
    policy = AgentPolicy()
    policy.start(aorta, 1)
    return policy


def test_a_wire_may_lie_in_loops_of_three_widths(aorta):
    assert far_end_mm(aorta.anatomy) == pytest.approx(80 + 3 * 24, abs=1.0)


def test_an_agent_holds_more_possible_of_the_ostium_and_pulls_loops_out(aorta, started):
    assert AgentConfig.of(aorta) is IN_WIDE_LUMEN
    deeper = np.array([member.ostium_mm for member in started.belief.members])
    assert deeper.min() < -3.0 and deeper.max() > 3.0
    grids = [grid for _, grid in Repertoire.of((), SearchConfig(), wide=True).ways]
    assert {grid[0].back for grid in grids} == {0.0, 1.5, 3.0}
    assert {grid[0].back for _, grid in Repertoire.of((), SearchConfig(), wide=False).ways} == {0.0}


def test_a_hurried_pair_keeps_a_course_that_it_is_little_off(aorta):
    """Fifty millimetres in 6 s leave no time for wire and catheter in turn; in a narrow vessel 3 mm are off course."""
    pair = replace(aorta, catheters=(read_catheter("vertebral-5f"),), seconds=6.0)
    hurried = AgentConfig.of(pair)
    assert hurried.search.manoeuvres.together and hurried.off_course_mm == 10.0
    assert AgentConfig.of(replace(pair, seconds=60.0)).off_course_mm == 3.0


def test_a_course_ends_where_most_wires_are_at_the_target(started, aorta):
    course = started.find_course(aorta.seconds)
    at = course.tip.abscissa[-1]
    # Wires lie so far apart that they are never all there together; those that are elsewhere do not lead the course.
    assert course.reached > 0.5 and len(at) < course.force.shape[1]
    assert np.abs(at - 50.0).min() <= 1.5
    assert (course.control[:, WIRE, 1] == 0).all()  # no other manoeuvre was tried


@pytest.fixture(scope="module")
def beyond_a_fork() -> AgentPolicy:
    """Return an agent whose wires lie some 15 mm beyond a fork, on the way to 70 mm."""
    trunk = np.linspace([0.0, 0, 0], [0, 0, 80], 81)
    side = np.linspace([0.0, 0, 40], [40.0, 0, 40], 41)
    anatomy = extract_anatomy(Polylines((trunk, side), (np.full(81, 10.0), np.full(41, 4.0))), name="fork")
    on = next(k for k, branch in enumerate(anatomy.tree.branches) if branch.centerline.points[-1][2] > 70)
    navigation = Navigation(
        anatomy=anatomy,
        target=Target(branch=on, abscissa=70.0),
        device=read_wire("j-035"),
        start_inserted_length_mm=57.0,
    )
    policy = AgentPolicy()
    policy.start(navigation, 1)
    return policy


def test_a_wire_that_is_stuck_beyond_a_fork_is_pulled_back_to_before_it(beyond_a_fork):
    search = beyond_a_fork._search
    course = search.find_turned(beyond_a_fork.belief, 0.0, seconds=60.0, out=True)
    speed, tip = course.control[:, WIRE, 0], course.tip.abscissa.mean(axis=1)
    turns_back = int(np.argmax(speed > 0))
    # 1.4 radii of the lumen, 10 mm, before the fork, and up to a period's 5 mm more.
    place = float(search.route.junctions[0]) - 1.4 * 10.0
    assert (speed[:turns_back] < 0).all() and tip[turns_back - 1] == pytest.approx(place - 2.5, abs=3.5)
    assert course.reached > 0.5


def test_a_search_first_goes_on_from_where_the_wire_lies(beyond_a_fork, monkeypatch):
    search, begun = beyond_a_fork._search, []
    search._behind_mm = 26.0
    failed = replace(search.find_turned(beyond_a_fork.belief, 0.0, seconds=1.0), reached=0.0)

    def find_turned(*_, out=False, **__):
        begun.append(out)
        return replace(failed, reached=float(out))

    monkeypatch.setattr(search, "find_turned", find_turned)
    assert search.find(beyond_a_fork.belief, seconds=60.0).reached == 1.0 and begun == [False, True]
    begun.clear()
    failed = replace(failed, reached=1.0)
    monkeypatch.setattr(search, "find_turned", lambda *_, out=False, **__: begun.append(out) or failed)
    assert search.find(beyond_a_fork.belief, seconds=60.0).reached == 1.0 and begun == [False]


def test_wires_beyond_a_target_are_pulled_back_to_it(started, aorta):
    near = AgentPolicy()
    near.start(replace(aorta, target=Target(branch=0, abscissa=30.0), start_inserted_length_mm=55.0), 1)
    course = near.find_course(aorta.seconds)  # their tips begin some 10 mm beyond
    assert course.reached > 0.5 and (course.control[:, WIRE, 0] < 0).all()
    assert (course.control[:, WIRE, 1] == 0).all()


def test_what_holds_for_two_periods_leaves_no_travel_after_them(aorta, started):
    limits = DriveLimits(max_velocity_mm_s=30.0, max_rotation_rad_s=3.0, travel_mm=(0.0, 6.0))
    trials = Trials(
        Trials.of(aorta, [(aorta.anatomy, aorta.stack)], 1, like=started.belief.simulator).simulator, [limits]
    )
    for periods in (1, 2):
        control = trials.possible(trials.control(Move(WIRE, 30.0)), periods=periods)
        assert control[0, WIRE, 0] == pytest.approx(6.0 / (periods * DECISION_PERIOD_S))


def test_of_gentle_ways_of_wire_and_catheter_the_straight_and_quick_one_is_taken(aorta):
    """Soft devices press as gently in loops, which end in coils."""
    pair = replace(aorta, catheters=(read_catheter("microcatheter-1.7f"),), device=read_wire("workhorse-014"))
    belief = Belief(pair, [World()], BeliefConfig(members=1))
    one = Search(pair, Route.to(pair.anatomy, pair.target), belief, config=SearchConfig(), seed=0)
    limit_n = pair.force_limit_n
    # By force: hardly any, a tenth of the limit, and half of it. By slack and periods:
    force, slack = limit_n * np.array([0.01, 0.1, 0.05, 0.5]), np.array([100.0, 0.0, 0.0, 0.0])
    passed = np.ones(4, dtype=bool)
    moved = (np.arange(20)[:, None] < [4, 4, 20, 4])[..., None, None] * np.ones((2, 2))  # then they wait
    rows = [Period(each, np.zeros((4, 2, 2)), belief.simulator.project()[:, 0], force) for each in moved]
    pushed = Pushed(rows, np.full(4, 20), passed, force, np.zeros(4), slack, ["late"] * 4)
    assert np.argsort(one.manoeuvre_cost(pushed)).tolist() == [1, 2, 0, 3]
