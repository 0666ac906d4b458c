"""The search for wire and catheter, straight on where that goes, else a manoeuvre at the fork; and its agent."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from endopilot.belief.belief import BeliefConfig
from endopilot.control.coaxial_agent import CoaxialAgent, CoaxialAgentConfig
from endopilot.control.coaxial_copies import CoaxialCourse, CoaxialSearchConfig
from endopilot.control.coaxial_search import CoaxialSearch
from endopilot.devices.catheter import read_catheter
from endopilot.errors import InputError
from endopilot.ladder.attempt import Recording, attempt, repeat
from endopilot.navigation.navigate import NavigateConfig, navigate, start_world
from endopilot.navigation.policy import Observation
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.mismatch import ModelMismatch
from endopilot.simulation.simulator import Simulator
from endopilot.tasks.navigation import DECISION_PERIOD_S, Navigation, Target
from endopilot.xray.fluoroscope import TipMeasurement

CORE = SimulatorConfig(element_mm=2.0, time_step_s=0.1, threads=1)
CONFIG = CoaxialSearchConfig(turns=4, core=CORE)
AGENT = CoaxialAgentConfig(
    search=CoaxialSearchConfig(turns=4),
    belief=BeliefConfig(members=2, stiffness_levels=1, element_mm=2.0, time_step_s=0.1),
)


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
        start_inserted_mm=10.0,
        start_rotation=np.pi,
        seconds=60.0,
        force_limit_n=0.3,
    )


@pytest.fixture(scope="module")
def found(side_branch) -> tuple[Simulator, CoaxialCourse]:
    """Return a start that looks away from the branch, and a course from there."""
    start = start_world(side_branch, ModelMismatch(), CORE)
    return start, CoaxialSearch(side_branch, CONFIG).find(start)


def test_a_course_into_a_side_branch_brings_wire_and_catheter_there(side_branch, found) -> None:
    start, course = found
    assert course.reached and 0 < course.peak_n <= 0.9 * 0.3
    assert start.inserted_length[0] == pytest.approx(10.0)  # the start stays as it is
    assert np.abs(course.control[:, 1]).sum() * DECISION_PERIOD_S > 0.5  # it has to turn
    assert course.settled.sum() == 2 and course.settled[-1] and not course.off_route[course.settled].any()
    assert len(course.control) == len(course.proximal) == len(course.abscissa) == len(course.off_route)
    assert (np.abs(course.control).sum(axis=1) > 0).all()  # without pauses


def test_the_controls_of_a_course_lead_where_it_says(side_branch, found) -> None:
    start, course = found
    again = Simulator(side_branch.anatomy, side_branch.device, catheters=side_branch.catheters, config=CORE)
    again.copy_worlds([0], of=start)
    for control, proximal, abscissa in zip(course.control, course.proximal, course.abscissa, strict=True):
        for _ in range(5):  # as `drive_period` does
            again.step(control[None], DECISION_PERIOD_S / 5)
        ends = [again.inserted_length[0], again.rotation[0]]
        ends += [again.catheter_inserted_length[0, 0], again.catheter_rotation[0, 0]]
        assert ends == proximal.tolist() and again.project().abscissa[0] == abscissa
    assert side_branch.reached(again.project(), again.project(1))[0]


def test_a_wire_that_leads_by_little_ends_little_beyond_the_target(side_branch, monkeypatch) -> None:
    monkeypatch.setattr("endopilot.control.coaxial_search._LEADS_MM", (3.0,))
    course = CoaxialSearch(side_branch, CONFIG).find(start_world(side_branch, ModelMismatch(), CORE))
    assert course.reached
    assert course.abscissa[-1] - side_branch.target.abscissa == pytest.approx(3.0, abs=2.0)


def test_where_no_manoeuvre_passes_the_search_says_where(side_branch, found) -> None:
    weak = replace(side_branch, force_limit_n=1e-6)
    search = CoaxialSearch(weak, replace(CONFIG, turns=1))
    course = search.find(start_world(weak, ModelMismatch(), CORE))
    assert not course.reached and len(course.control) == 0
    assert search.halted_mm == search.route.waypoints[0]


def test_the_agent_arrives_with_little_xray(side_branch) -> None:
    policy = CoaxialAgent(AGENT)
    record = navigate(side_branch, policy, config=NavigateConfig(simulator=CORE), seed=2)
    assert record.reason == "reached" and record.safe
    assert policy.plans >= 1 and record.exposures < len(record.time_s) / 2
    along, across = policy.believed().half_width
    assert along > 0 and across > 0


def test_a_wire_that_no_simulated_one_explains_is_pulled_back_until_one_does(side_branch) -> None:
    policy = CoaxialAgent(AGENT)
    policy.start(side_branch, 0)
    believed = policy.belief.simulator.tips()[0]

    def seen(shift_mm: float, sd_mm: float = 0.0) -> Observation:
        tip = TipMeasurement(believed + np.array([0.0, 0.0, shift_mm]), 10.0 + shift_mm, 0.0, 0, (sd_mm, sd_mm))
        return Observation(0.0, ((10.0, np.pi), (0.0, 0.0)), tip)

    lost = policy.decide(seen(8.0))
    assert lost.devices[0][0] < 0 and lost.devices[1][0] == 0.0 and lost.expose and policy.plans == 0
    inside = policy.decide(replace(seen(8.0), devices=((10.0, np.pi), (12.0, 0.0))))
    assert inside.devices[0][0] < 0 and inside.devices[1][0] < 0
    policy.start(side_branch, 0)
    assert policy.decide(seen(0.5)).devices[0][0] >= 0 and policy.plans == 1
    policy.start(side_branch, 0)
    assert policy.decide(seen(8.0, sd_mm=4.0)).devices[0][0] >= 0 and policy.plans == 1  # a poor image proves little


def test_a_ladder_counts_the_events_that_the_agent_misses(side_branch) -> None:
    beside = replace(side_branch, target=Target(branch=0, abscissa=16.0), start_inserted_mm=14.0)
    result = attempt("coaxial-agent", beside, seed=1)
    events, missed = result["events"]
    assert result["success"] and 0 <= missed <= events
    assert repeat(Recording.unpacked(result["recording"], devices=2), beside, seed=1)["events"] == result["events"]


def test_the_agent_drives_one_catheter(side_branch) -> None:
    alone = replace(side_branch, catheters=(), arrives="wire")
    with pytest.raises(InputError, match="policy: drives a catheter too, and there is none"):
        navigate(alone, "coaxial-agent")
    outer = read_catheter("straight-5f")
    wide = replace(outer, device=replace(outer.device, diameter_mm=1.25))
    with pytest.raises(InputError, match="policy: drives one catheter, and there are 2"):
        navigate(replace(side_branch, catheters=(*side_branch.catheters, wide)), "coaxial-agent")
