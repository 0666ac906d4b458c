"""A wire alone in a wide lumen, such as an aorta: what the agent holds possible, tries and waits for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from endopilot.anatomy.extract import extract_anatomy
from endopilot.control.agent import AgentPolicy
from endopilot.control.agent_config import IN_WIDE_LUMEN, AgentConfig
from endopilot.control.trials import WIRE, Trials
from endopilot.devices.catheter import read_catheter
from endopilot.devices.device import read_wire
from endopilot.devices.drive_limits import DriveLimits, far_end_mm
from endopilot.tasks.navigation import DECISION_PERIOD_S, Navigation, Target
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


def test_a_hurried_pair_keeps_a_course_that_it_is_little_off(aorta):
    """Fifty millimetres in 6 s leave no time for wire and catheter in turn; in a narrow vessel 3 mm are off course."""
    pair = replace(aorta, catheters=(read_catheter("vertebral-5f"),), seconds=6.0)
    hurried = AgentConfig.of(pair)
    assert hurried.search.together and hurried.off_course_mm == 10.0
    assert AgentConfig.of(replace(pair, seconds=60.0)).off_course_mm == 3.0


def test_a_course_ends_where_most_wires_are_at_the_target(started, aorta):
    course = started.find_course(aorta.seconds)
    at = course.tip.abscissa[-1]
    # Wires lie so far apart that they are never all there together; those that are elsewhere do not lead the course.
    assert course.reached > 0.5 and len(at) < course.force.shape[1]
    assert np.abs(at - 50.0).min() <= 1.5
    assert (course.control[:, WIRE, 1] == 0).all()  # no other manoeuvre was tried


def test_wires_beyond_a_target_are_pulled_back_to_it(started, aorta):
    near = AgentPolicy()
    near.start(replace(aorta, target=Target(branch=0, abscissa=30.0), start_inserted_length_mm=55.0), 1)
    course = near.find_course(aorta.seconds)  # their tips begin some 10 mm beyond
    assert course.reached > 0.5 and course.control[0, WIRE, 0] < 0
    assert (course.control[:, WIRE, 1] == 0).all()


def test_a_control_leaves_no_travel_after_its_period(aorta, started):
    limits = DriveLimits(max_velocity_mm_s=30.0, max_rotation_rad_s=3.0, travel_mm=(0.0, 6.0))
    trials = Trials(
        Trials.of(aorta, [(aorta.anatomy, aorta.stack)], 1, like=started.belief.simulator).simulator, [limits]
    )
    control = trials.possible(trials.control(30.0))
    assert control[0, WIRE, 0] == pytest.approx(6.0 / DECISION_PERIOD_S)
