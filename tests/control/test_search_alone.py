"""The search for a wire alone: what its courses hold, where they begin and end, and what it says of its failures."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from endopilot.belief.belief import Belief
from endopilot.control.agent import OraclePolicy
from endopilot.control.set_up import describe_halt
from endopilot.control.trials import drive_period
from endopilot.simulation.motion import motion_named
from endopilot.simulation.world import World
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
