"""The baseline policies do what their names say, and are found by their names."""

from __future__ import annotations

import numpy as np
import pytest

from endopilot.navigation.baseline_policies import ADVANCE_MM_S, SPIN_RAD_S, Forward, RetractRotate, Spin
from endopilot.navigation.policies import POLICIES, make_policy
from endopilot.navigation.policy import Observation, Policy
from endopilot.tasks.navigation import Navigation, Target
from endopilot.xray.fluoroscope import TipMeasurement


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
