"""A wire and a catheter in closed loop: drives of their own, policies that drive both, and what takes a wire alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from endopilot.devices.catheter import Catheter, read_catheter
from endopilot.errors import InputError
from endopilot.navigation.baseline_policies import LEAD_MM, CatheterAlone
from endopilot.navigation.loop import LoopConfig, NavigationLoop
from endopilot.navigation.policy import Decision, Hand, Observation
from endopilot.simulation.config import SimulatorConfig
from endopilot.tasks.navigation import Navigation, Target

COARSE = LoopConfig(simulator=SimulatorConfig(element_mm=1.5, time_step_s=0.05, threads=1))


@pytest.fixture(scope="module")
def catheter() -> Catheter:
    return read_catheter("microcatheter-1.7f")


@pytest.fixture
def over_the_wire(fork, wire, catheter) -> Navigation:
    """Return a target before the fork to which the catheter's tip is to go."""
    return Navigation(
        anatomy=fork,
        device=wire,
        target=Target(branch=0, abscissa=17.0),
        catheters=(catheter,),
        arrives="catheter",
        seconds=30.0,
    )


def test_the_catheter_follows_in_turn_and_the_same_controls_simulate_the_same(over_the_wire) -> None:
    record = NavigationLoop(over_the_wire, "in-turn", config=COARSE, seed=1).run()
    assert record.reason == "reached" and record.faults == 0
    periods = len(record.time_s) - 1
    assert record.control.shape == (periods + 1, 2, 2) and record.cycles.command.shape == (1, 10 * periods, 2, 2)
    assert record.inserted_length.shape == record.rotation.shape == record.tip.abscissa.shape == (periods + 1, 2)
    inserted, catheter = record.inserted_length.T
    assert (np.diff(inserted) > -0.1).all()  # the wire is not pulled out
    assert catheter[-1] > 15.0 and (inserted - catheter).max() < LEAD_MM + 5.0
    moving = (np.abs(record.control[..., 0]) > 0).sum(axis=1)
    assert moving.max() == 1  # one at a time
    again = record.cycles.replay()
    np.testing.assert_array_equal(again.tip_position[0, 9::10], record.tip_position[1:])
    np.testing.assert_array_equal(again.inserted_length[0, 9::10], record.inserted_length[1:])


def test_a_catheter_that_a_policy_does_not_name_stands_still(over_the_wire) -> None:
    wire_first = replace(over_the_wire, arrives="wire")
    record = NavigationLoop(wire_first, "forward", config=COARSE).run()
    assert record.reason == "reached" and np.ptp(record.inserted_length[:, 1]) == 0.0
    assert not record.control[:, 1].any() and record.faults == 0
    # the wire alone does not bring the catheter's tip there
    assert NavigationLoop(over_the_wire, "forward", config=COARSE).run().reason == "time"


def test_orders_are_kept_within_each_drive_s_limits(over_the_wire, catheter) -> None:
    class Wild:
        def start(self, navigation, seed): ...

        def decide(self, observation: Observation) -> Decision:
            assert len(observation.devices) == 2
            return Decision(((0.0, 0.0), (1e9, np.nan)))

    loop = NavigationLoop(over_the_wire, Wild(), config=COARSE)
    assert loop.step().devices == ((0.0, 0.0), (0.0, 0.0))
    loop.hand_over(Hand(((1.0, 0.0), (1e9, 0.0), (1.0, 1.0))))
    assert loop.step().devices == ((1.0, 0.0), (catheter.max_velocity_mm_s, 0.0))
    assert loop.record().faults == 2


def test_a_catheter_alone_takes_the_wire_along(over_the_wire) -> None:
    alone = CatheterAlone()
    alone.start(over_the_wire, 0)
    decisions = [alone.decide(Observation(0.0, ((5.0, 0.0), (at, 0.0)), None)) for at in (0.0, 5.1, 60.0)]
    moves = [tuple(speed > 0 for speed, _ in each.devices) for each in decisions]
    assert moves == [(False, True), (True, True), (False, False)]


def test_what_takes_a_wire_alone_says_so(over_the_wire) -> None:
    line = "takes a wire alone, and there is microcatheter-1.7f around it; leave the catheter out"
    with pytest.raises(InputError, match=line):
        NavigationLoop(over_the_wire, "in-turn", config=replace(COARSE, xray="images")).run()
    alone = replace(over_the_wire, catheters=(), arrives="wire")
    for policy in ("in-turn", "catheter-alone"):
        with pytest.raises(InputError, match="policy: drives a catheter too, and there is none"):
            NavigationLoop(alone, policy, config=COARSE).run()
