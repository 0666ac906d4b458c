"""Wire and catheter that move together where time is short: what is drawn, who goes ahead, how far courses lead."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from endopilot.belief.belief import Belief, BeliefConfig
from endopilot.control.agent import AgentPolicy
from endopilot.control.agent_config import AgentConfig
from endopilot.control.course import next_place, places_of
from endopilot.control.population import ConstantMotions, Population
from endopilot.control.push import Push
from endopilot.control.search import Search
from endopilot.control.trials import CATHETER, WIRE, Move, Trials
from endopilot.navigation.loop import LoopConfig, NavigationLoop
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.world import World
from endopilot.tasks.navigation import Navigation, Target
from endopilot.tasks.route import Route

BELIEF = BeliefConfig(members=2, stiffness_levels=1, element_mm=2.0, time_step_s=0.1)


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


def test_a_wire_is_turned_on_where_a_straight_push_fails(pair) -> None:
    """From a start that looks away from it, the wire does not enter the side branch as it is pushed."""
    side = replace(pair, target=Target(branch=2, abscissa=30.0), start_rotation_rad=np.pi)
    search, belief = begin(side)
    assert not Push(search.route, side, search.config, 22.5).run(search._course, 40).passed[0]
    course = search.find(belief, seconds=60.0)
    assert course.reached == 1.0 and search.halt == ""
    assert np.abs(course.control[:, WIRE, 1]).max() > 0


def test_motions_of_both_devices_are_drawn_where_turning_does_not_help(pair, monkeypatch) -> None:
    """Where the wire goes ahead its catheter rests then; else that is moved too."""
    monkeypatch.setattr(ConstantMotions, "best", lambda *_: (np.zeros((4, 2, 2)), -np.inf))
    found, find = [], Population.find

    def note(*given, **named):
        found.append((named["rests"], *find(*given, **named)))
        return found[-1][1:]

    monkeypatch.setattr(Population, "find", note)
    side = replace(pair, target=Target(branch=2, abscissa=30.0), start_rotation_rad=np.pi)
    for arrives, rests in (("wire", True), ("catheter", False)):
        search, belief = begin(replace(side, arrives=arrives))
        course = search.find(belief, seconds=60.0, horizon_mm=100.0)
        assert found and all(each[0] == rests for each in found)
        if search.halt == "":
            assert np.array_equal(course.control[-len(found[-1][1]) :], found[-1][1])
        draws = search._population._draw(np.zeros((8, 2, 2)), 2, 0)
        assert (draws[:, CATHETER, 0] != 0).any() == (not rests) and not draws[:, CATHETER, 1].any()
        found.clear()


def test_a_course_ends_beyond_its_horizon_and_is_no_failure(pair) -> None:
    late = replace(pair, arrives="catheter", seconds=12.0)
    search, belief = begin(late)
    places = places_of(search.route, 6.0, alone=False, together=True)
    course = search.find(belief, seconds=30.0, horizon_mm=5.0)
    assert len(places) > 1 and course.reached == 0.0 and search.halt == ""
    assert 11.0 <= course.tip.abscissa[-1, 0] < places[-1]
    policy = AgentPolicy(replace(AgentConfig.of(late), belief=BELIEF, horizon_mm=5.0, tries=1))
    core = SimulatorConfig(element_mm=2.0, time_step_s=0.1, threads=1)
    record = NavigationLoop(late, policy, config=LoopConfig(simulator=core), seed=2).run()
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
