"""The search for a wire alone: what its courses hold, what it says of its failures, and what it may spend."""

from __future__ import annotations

import gc
import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from endopilot.belief.belief import Belief
from endopilot.belief.thought import Budget, OutOfBudgetError
from endopilot.belief.vessels import SharedVessels
from endopilot.control.agent import AgentPolicy, OraclePolicy
from endopilot.control.drive import Outcome
from endopilot.control.set_up import describe_halt
from endopilot.control.trials import drive_period
from endopilot.navigation.loop import NavigationLoop
from endopilot.simulation.motion import motion_named
from endopilot.simulation.world import World
from endopilot.tasks.navigation import Navigation
from endopilot.tasks.route import Route
from toy_belief import QUICK


@pytest.mark.parametrize("known", ["still", "both"])
def test_a_course_is_what_the_simulator_does_under_its_controls(side_branch, known) -> None:
    side_branch = replace(side_branch, known_motion=motion_named(known))
    policy = OraclePolicy(config=QUICK)
    policy.start(side_branch, 0)
    course = policy.find_course(side_branch.seconds)
    assert course.reached == 1.0
    moved = side_branch.start_inserted_length_mm + 0.5 * np.cumsum(course.control[:, 0, 0])
    assert np.allclose(course.proximal[:, 0, 0], moved, atol=1e-9)
    simulator = Belief(side_branch, [World()], QUICK.belief).simulator
    for k in range(len(course.control)):
        looks = [simulator.step(course.control[k], 0.1) for _ in range(5)]
        assert simulator.project().abscissa[0, 0] == course.tip.abscissa[k, 0]
        assert course.force[k, 0] == max(look.contact_force_max[0] for look in looks)
    assert side_branch.reached(simulator.project())[0]


def test_advice_names_a_tip_at_forks_alone(side_branch) -> None:
    """A wire that meets its limits where no branch leaves does not need a larger bend."""
    route = Route.to(side_branch.anatomy, side_branch.target)
    for halt, words in (("slipped", "drive slips.*0.5 N"), ("pressed", "0.5 N on the wall"), ("stalled", "folds")):
        said = describe_halt(halt, 9.0, route, side_branch)
        assert "at 9 mm, where no branch leaves" in said and re.search(words, said)
        assert "does not enter" not in said
    assert "40 s are over" in describe_halt("late", 9.0, route, side_branch)
    assert "does not enter" in describe_halt("off", 20.5, route, side_branch)


def test_a_search_takes_no_path_that_presses_harder_than_the_limit(side_branch) -> None:
    """Under a limit below what the branch takes there is no path, and no part of one that breaks the limit."""
    policy = OraclePolicy(config=QUICK)
    policy.start(side_branch, 0)
    needed = float(policy.find_course(20.0).force.max())
    tight = replace(side_branch, force_limit_n=0.25 * needed)
    policy.start(tight, 0)
    course = policy.find_course(20.0)
    assert course.reached == 0.0 and course.force.max(initial=0.0) <= tight.force_limit_n
    assert "on the wall; give a larger force_limit_n" in policy.halt


def test_a_wire_that_lies_beyond_its_target_is_pulled_back(side_branch) -> None:
    """Motions are drawn about the target then, however far beyond a straight push would come."""
    short = replace(
        side_branch, target=replace(side_branch.target, branch=0, abscissa=8.0), start_inserted_length_mm=19
    )
    policy = OraclePolicy(config=QUICK)
    policy.start(short, 0)
    course = policy.find_course(20.0)
    assert course.reached == 1.0 and course.control[:, 0, 0].min() < 0
    assert policy._search._hard > 15.0 and policy._search._obstacle(8.0)[0] == 8.0


def test_what_all_wires_say_of_a_motion_corrects_what_the_likeliest_says(side_branch) -> None:
    """Motions that keep within a tight limit with the likeliest wire do not with others, and are cheap no longer."""
    policy = OraclePolicy(config=QUICK)
    policy.start(side_branch, 0)
    needed = float(policy.find_course(20.0).force.max())
    agent, corrected = AgentPolicy(QUICK), 0
    agent.start(replace(side_branch, force_limit_n=0.9 * needed), 0)
    follow = agent._search._follow

    def noted(outcome: Outcome, *rest: Any) -> bool:
        nonlocal corrected
        said, cost = outcome.share.copy(), outcome.cost(1.0)
        passed = follow(outcome, *rest)
        changed = outcome.share != said
        corrected += int(changed.sum())
        assert (outcome.share[changed] == 0).all() and (outcome.cost(1.0)[changed] > cost[changed]).all()
        return passed

    agent._search._follow = noted
    agent.find_course(20.0)
    assert corrected > 10


def test_a_force_that_a_snap_ends_within_a_period_counts(side_branch) -> None:
    """Where the tip slips, the wall bears more before than at the end of the period."""
    policy = OraclePolicy(config=QUICK)
    policy.start(side_branch, 0)
    simulator, ends = policy.belief.simulator, []
    for _ in range(10):
        peak = drive_period(simulator, np.array([[8.0, 0.0]])).contact_force_max[0]
        ends.append((peak, simulator.contacts.max()))
    peaks, last = np.array(ends).T
    assert (peaks >= last).all() and (peaks > 2 * last).any()


def test_seconds_or_evaluations_end_a_budget() -> None:
    for budget in (Budget(0.0), Budget(1e9, evaluations=5)):
        with pytest.raises(OutOfBudgetError):
            for _ in range(3):
                budget.spend(2)
        assert budget.over
        budget.begin()
        assert not budget.over


def test_another_lumen_is_taken_off_the_budget(side_branch) -> None:
    """Making it takes as long as 0.3 evaluations for each point of its map; what is made already costs nothing."""
    budget, vessels = Budget(), SharedVessels(side_branch.anatomy)
    for members in ([World()], [World(), World(lumen_factor=1.1)], [World(lumen_factor=1.1)]):
        vessels.kinds(side_branch.stack, members, budget)
    assert budget.spent == pytest.approx(0.3 * vessels.of(World(lumen_factor=1.1)).distance_map.values.size)


def test_a_search_ends_with_what_it_has(side_branch) -> None:
    """With little it comes to before the fork, and with less nowhere; the words say why."""
    free, few, none = (OraclePolicy(config=replace(QUICK, evaluations=each)) for each in (10**9, 10**5, 1))
    lengths = []
    for policy in (free, few, none):
        policy.start(side_branch, 0)
        lengths.append(len(policy.find_course(side_branch.seconds).control))
    assert lengths[0] > lengths[1] >= 0 == lengths[2] and free.halt == ""
    assert "in its budget; give more (AgentConfig.evaluations)" in few.halt


def navigated(navigation: Navigation, **settings: Any) -> tuple[NavigationLoop, list[bool]]:
    """Return a navigation that is over, and whether its search went on after each decision."""
    loop = NavigationLoop(navigation, OraclePolicy(config=replace(QUICK, **settings)))
    busy = []
    while loop.reason is None and not loop.gives_up:
        loop.step()
        busy.append(loop.policy._thought is not None)
    return loop, busy


def test_a_search_goes_on_while_devices_follow_what_it_has_found(side_branch) -> None:
    """They move before it has ended, rest where no more is known, and in the end have done what one search finds."""
    (at_once, _), (slowly, busy) = navigated(side_branch), navigated(side_branch, decision_evaluations=100_000)
    control = slowly.record().control
    moves = control.any(axis=(1, 2))[:-1]  # the last row is the end
    assert slowly.reason == at_once.reason == "reached" and sum(busy) > 5
    assert (moves & busy).any() and (~moves & busy).any() and moves[~np.array(busy)].all()
    assert np.allclose(control.sum(axis=0), at_once.record().control.sum(axis=0), rtol=0.05, atol=0.5)


def test_by_evaluations_a_navigation_repeats(side_branch) -> None:
    """Which thread is the faster plays no part."""
    records = [navigated(side_branch, decision_evaluations=200_000)[0].record() for _ in "ab"]
    assert records[0].reason == "reached" and np.array_equal(records[0].control, records[1].control)


def test_by_seconds_a_decision_does_not_wait(side_branch) -> None:
    """A decision that waits for next to nothing leaves the search behind; it arrives all the same."""
    loop, busy = navigated(replace(side_branch, seconds=1000.0), decision_s=1e-6)
    assert busy[0] and loop.reason == "reached"


def test_a_search_that_nobody_waits_for_ends(side_branch) -> None:
    """With the policy goes its thread."""
    loop = NavigationLoop(side_branch, OraclePolicy(config=replace(QUICK, decision_evaluations=1)))
    loop.step()
    thread = loop.policy._thought._thread
    assert thread.is_alive()
    del loop
    gc.collect()
    thread.join(timeout=60.0)
    assert not thread.is_alive()
