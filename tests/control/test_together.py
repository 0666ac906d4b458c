"""Wire and catheter that move together where time is short: what is drawn, who goes ahead, how far courses lead."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from endopilot.belief.belief import Belief, BeliefConfig
from endopilot.control.agent import AgentPolicy
from endopilot.control.agent_config import AgentConfig
from endopilot.control.places import next_place, places_of
from endopilot.control.population import Population
from endopilot.control.push import ALL_ALONG_MM, Push
from endopilot.control.search import Search
from endopilot.control.trials import CATHETER, WIRE, Move, Trials
from endopilot.devices.catheter import read_catheter
from endopilot.navigation.loop import LoopConfig, NavigationLoop
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.world import World
from endopilot.tasks.navigation import Navigation, Target
from endopilot.tasks.route import Route

BELIEF = BeliefConfig(members=2, stiffness_levels=1, element_mm=2.0, time_step_s=0.1)


@pytest.fixture(scope="module")
def pair(fork, wire) -> Navigation:
    """Return a navigation of a pair that has too little time to move in turn, to a place straight ahead."""
    return Navigation(
        anatomy=fork,
        device=wire,
        target=Target(branch=1, abscissa=34.0),
        catheters=(read_catheter("microcatheter-1.7f"),),
        start_inserted_length_mm=6.0,
        seconds=8.0,
        force_limit_n=0.3,
    )


def begin(navigation: Navigation, **manoeuvres: object) -> tuple[Search, Belief]:
    """Return a search whose course begins where the navigation does."""
    config, belief = AgentConfig.of(navigation), Belief(navigation, [World()], BELIEF)
    config = replace(config.search, candidates=8, manoeuvres=replace(config.search.manoeuvres, turns=4, **manoeuvres))
    route = Route.to(navigation.anatomy, navigation.target)
    search = Search(navigation, route, belief, config=config, seed=0)
    search._course.put(np.array([0]), belief.simulator, np.ones(1))
    return search, belief


def test_the_wire_goes_ahead_where_the_lumen_is_narrow_and_its_tip_is_to_arrive(pair) -> None:
    search, belief = begin(pair)
    course = search.find(belief, seconds=30.0)
    assert course.reached == 1.0 and not course.control[:, CATHETER].any()
    search, belief = begin(replace(pair, arrives="catheter"))
    course = search.find(belief, seconds=30.0)
    assert course.reached == 1.0 and course.control[:, CATHETER, 0].max() > 0


def test_a_catheter_that_rests_lets_its_wire_go_all_the_way_alone(pair) -> None:
    """Else it follows to 10 mm behind the wire's tip as soon as that is past the place."""
    ends = []
    for rests in (False, True):
        search, _ = begin(pair)
        push = Push(search.route, pair, search.config, 28.0, rests=rests)
        push.run(search._course, 40, np.array([ALL_ALONG_MM]))
        ends.append([search._course.inserted(device)[0] for device in (WIRE, CATHETER)])
    assert ends[0][0] > 28.0 and ends[1][0] > 28.0
    assert ends[0][1] == pytest.approx(ends[0][0] - 10.0, abs=0.2) and ends[1][1] == 0.0


def test_a_catheter_follows_over_the_resting_wire(pair) -> None:
    search, _ = begin(pair)
    search._together.most_periods = 100
    assert not search._together.support()  # it is 6 mm behind the wire already
    search._course.move(search._course.control(Move(WIRE, 40.0)))
    wire_mm = float(search._course.inserted(WIRE)[0])
    assert search._together.support()
    assert search._course.inserted(WIRE)[0] == pytest.approx(wire_mm, abs=1e-9)
    assert search._course.inserted(CATHETER)[0] == pytest.approx(wire_mm - 10.0, abs=0.2)


def test_motions_of_both_devices_are_drawn_where_a_straight_push_fails(pair, monkeypatch) -> None:
    """From a start that looks away from it, the wire does not enter the side branch as it is pushed."""
    side = replace(pair, target=Target(branch=2, abscissa=30.0), seconds=8.0)
    search, belief = begin(replace(side, start_rotation_rad=np.pi))
    drawn, find = [], Population.find

    def note(*given, **named):
        drawn.append(find(*given, **named))
        return drawn[-1]

    monkeypatch.setattr(Population, "find", note)
    course = search.find(belief, seconds=60.0, horizon_mm=100.0)
    assert drawn and course.reached <= 0.5 and search.halt == ""  # it ends with what was drawn, and nothing failed
    assert np.array_equal(course.control[-len(drawn[-1][0]) :], drawn[-1][0])
    moved = np.concatenate([controls for controls, _ in drawn])
    assert np.abs(moved[:, WIRE, 1]).max() > 0
    draws = search._population._draw(np.zeros((8, 2, 2)), 2, 0)
    assert (draws[:, CATHETER, 0] != 0).any() and (draws[:, CATHETER, 0] == 0).any()
    assert not draws[:, CATHETER, 1].any()


def test_a_course_ends_beyond_its_horizon_and_is_no_failure(pair) -> None:
    search, belief = begin(pair)
    places = places_of(search.route, 6.0, alone=False, together=True)
    course = search.find(belief, seconds=30.0, horizon_mm=5.0)
    assert len(places) > 1 and course.reached == 0.0 and search.halt == ""
    assert 11.0 <= course.tip.abscissa[-1, 0] < places[-1]
    policy = AgentPolicy(replace(AgentConfig.of(pair), belief=BELIEF, horizon_mm=5.0, tries=1))
    core = SimulatorConfig(element_mm=2.0, time_step_s=0.1, threads=1)
    record = NavigationLoop(pair, policy, config=LoopConfig(simulator=core), seed=2).run()
    assert record.reason == "reached" and policy.plans > 1


def test_places_lie_at_forks_and_between_them(fork) -> None:
    route = Route.to(fork, Target(branch=2, abscissa=35.0))
    assert places_of(route, 0.0, alone=True, together=False) == route.waypoints.tolist() == pytest.approx([22.5, 35.0])
    stretches = places_of(route, 0.0, alone=False, together=False)
    assert stretches == pytest.approx([11.25, 22.5, 35.0])
    assert places_of(route, 0.0, alone=False, together=True) == pytest.approx([22.5, 35.0])
    assert places_of(route, 30.0, alone=False, together=False) == pytest.approx([35.0])
    assert next_place(stretches, 22.6, alone=False) == 35.0 and next_place(stretches, 22.6, alone=True) == 22.5
    assert next_place(stretches, 40.0, alone=False) == 35.0


def test_trials_go_back_and_forth_between_places_that_were_kept(pair) -> None:
    search, _ = begin(pair)
    course: Trials = search._course
    first = course.kept()
    course.move(course.control(Move(WIRE, 5.0)))
    later = course.kept()
    course.move(course.control(Move(WIRE, -3.0)))
    for kept, periods, inserted_mm in ((first, 0, 6.0), (later, 1, 8.5), (first, 0, 6.0)):
        course.restore(kept)
        assert len(course.rows) == kept.periods == periods
        assert course.inserted(WIRE)[0] == pytest.approx(inserted_mm, abs=1e-9)


def test_a_pair_that_moves_together_is_searched_for_step_by_step(pair) -> None:
    hurried, slow = AgentConfig.of(pair), AgentConfig.of(replace(pair, seconds=60.0))
    assert slow.horizon_mm is None and slow.belief.copies == 0 and slow.losses == 4
    assert hurried.horizon_mm == 60.0 and hurried.belief.copies > 0
    assert hurried.tries == hurried.losses == 20 and hurried.most_exposures == 100


def test_a_stuck_wire_is_pulled_back_and_its_catheter_only_where_it_is_in_the_way(pair, monkeypatch) -> None:
    """The catheter's tip is in the way in a branch that is not on the route, or where the wire's lies in it."""
    search, _ = begin(pair)
    devices, course = search._together, search._course
    devices.most_periods = 100
    course.move(course.control(Move(WIRE, 40.0), Move(CATHETER, 20.0)))
    kept, before = course.kept(), [float(course.inserted(device)[0]) for device in (WIRE, CATHETER)]
    for off_mm in (0.0, 5.0):
        monkeypatch.setattr(Route, "off_route", lambda _, tip, off_mm=off_mm: np.full(tip.abscissa.shape, off_mm))
        devices.retreat(kept)
        back = [was - float(course.inserted(device)[0]) for device, was in zip((WIRE, CATHETER), before, strict=True)]
        assert back[0] > 5.0 and (back[1] > 0) == (off_mm > 0)
