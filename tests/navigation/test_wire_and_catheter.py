"""The baseline policies, and a wire and a catheter in closed loop."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from endopilot.devices.catheter import Catheter, read_catheter
from endopilot.errors import InputError
from endopilot.navigation.baseline_policies import (
    ADVANCE_MM_S,
    LEAD_MM,
    SPIN_RAD_S,
    CatheterAlone,
    Forward,
    RetractRotate,
    Spin,
)
from endopilot.navigation.loop import LoopConfig, NavigationLoop
from endopilot.navigation.policies import POLICIES, make_policy
from endopilot.navigation.policy import Decision, Hand, Observation, Policy
from endopilot.simulation.config import SimulatorConfig
from endopilot.tasks.navigation import Navigation, Target
from endopilot.xray.fluoroscope import TipMeasurement

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


@pytest.fixture
def navigation(fork, wire) -> Navigation:
    """Return the navigation into the side branch, which leaves after 20 mm."""
    side = min(fork.tree.leaves(), key=lambda leaf: fork.tree.branches[leaf].centerline.radius[-1])
    return Navigation(anatomy=fork, device=wire, target=Target(branch=side, abscissa=30.0))


def _sight(inserted: float, rotation: float = 0.0, tip: TipMeasurement | None = None) -> Observation:
    return Observation(time_s=0.0, devices=((inserted, rotation),), tip=tip)


def _seen(navigation: Navigation, abscissa: float, *, wrong: bool = False) -> TipMeasurement:
    """Return a measured tip on the route, or in the other branch."""
    tree, target = navigation.anatomy.tree, navigation.target.branch
    other = next(leaf for leaf in tree.leaves() if leaf != target)
    branch = 0 if abscissa <= 20.0 else other if wrong else target
    return TipMeasurement(position=np.zeros(3), abscissa=abscissa, offset=0.0, branch=branch)


@pytest.mark.parametrize("name", POLICIES.shipped)
def test_a_policy_is_found_by_its_name(name, navigation):
    policy = make_policy(name)
    assert isinstance(policy, Policy)
    assert make_policy(name) is not policy


@pytest.mark.parametrize(("policy", "rotation"), [(Forward(), 0.0), (Spin(), SPIN_RAD_S)])
def test_forward_and_spin_push_until_the_target_lies_behind_them(policy, rotation, navigation):
    policy.start(navigation, seed=0)
    going, past = policy.decide(_sight(49.0)), policy.decide(_sight(50.1))
    assert (*going.devices, going.expose) == ((ADVANCE_MM_S, rotation), False)
    assert (*past.devices, past.expose) == ((0.0, 0.0), False)


def test_a_missed_branch_is_retracted_from_rotated_at_and_tried_again(navigation):
    policy = RetractRotate()
    policy.start(navigation, seed=0)
    assert policy.decide(_sight(19.0, tip=_seen(navigation, 18.0))).devices[0][0] == ADVANCE_MM_S
    for abscissa in (25.0, 21.0, 16.0):
        decision = policy.decide(_sight(abscissa + 1.0, 0.3, _seen(navigation, abscissa, wrong=True)))
        assert decision.devices == ((-ADVANCE_MM_S, 0.0),)
    rotation, decisions = 0.3, 0
    while (decision := policy.decide(_sight(15.0, rotation, _seen(navigation, 14.5)))).devices[0][0] == 0.0:
        assert 0 < decision.devices[0][1] <= SPIN_RAD_S
        rotation, decisions = rotation + 0.5 * decision.devices[0][1], decisions + 1
        assert decisions < 10
    assert rotation == pytest.approx(0.3 + np.pi, abs=0.06)
    assert decision.devices[0][0] == ADVANCE_MM_S
    assert policy.decide(_sight(26.0, rotation, _seen(navigation, 25.0))).devices[0][0] == ADVANCE_MM_S


def test_a_caught_wire_is_freed(navigation):
    policy = RetractRotate()
    policy.start(navigation, seed=0)
    moves = [policy.decide(_sight(10.0 + i, tip=_seen(navigation, 10.0))).devices[0][0] for i in range(9)]
    assert moves[0] > 0 > moves[-1]


def test_every_decision_of_retract_rotate_asks_for_x_ray(navigation):
    policy = RetractRotate()
    policy.start(navigation, seed=0)
    assert policy.decide(_sight(10.0)).expose and policy.decide(_sight(10.0)).devices[0][0] == 0.0
    assert policy.decide(_sight(10.0, tip=_seen(navigation, 10.0))).expose
