"""The simulated wires: how they follow the drives, and how an exposure weighs them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from endopilot.belief.belief import Belief, BeliefConfig
from endopilot.navigation.loop import start_world
from endopilot.simulation.motion import motion_named
from endopilot.simulation.world import World
from toy_belief import QUICK, measured


def test_an_exposure_says_how_a_wire_is_turned_that_its_encoder_does_not(side_branch, with_play) -> None:
    """The real drive had all of its play before it, of which the belief knows nothing."""
    belief = Belief(replace(side_branch, robot=with_play), [World()], QUICK.belief)
    true = Belief(side_branch, [World()], QUICK.belief)
    belief.follow(((12.6, 0.0),))
    true.follow(((10.0, 0.0),))  # the play was ahead
    belief.weigh(measured(true, 0))
    belief.follow(((12.6, 5.0),))
    true.follow(((10.0, 1.5),))
    unsure = belief.drives.sd[0].copy()
    for _ in range(3):
        belief.weigh(measured(true, 0))
    assert unsure[1] > 1.0 and belief.drives.sd[0, 1] < 0.4
    np.testing.assert_allclose(belief.drives.proximal[0], [10.0, 1.5], atol=0.35)
    np.testing.assert_allclose(belief.simulator.proximal[0, 0], [10.0, 1.5], atol=0.35)  # and there its wires are
    assert belief.play_spread()[0] == belief.drives.sd[0, 0]


def test_measurements_weigh_the_member_that_they_are_of(side_branch) -> None:
    config = BeliefConfig(members=6, time_step_s=0.05, ostium_spread_mm=2.0)
    belief = Belief(side_branch, Belief.around(config), config)
    assert len(belief.kinds) == 3 and np.ptp(belief.ostium_mm) > 1.0
    assert np.allclose(belief.weight, 1 / 6)
    wide = belief.tip_spread()
    for k in range(4):
        belief.follow(((4.0 + 2.0 * k, 0.0),))
        assert np.allclose(belief.simulator.inserted_length[:, 0] - belief.ostium_mm, 4.0 + 2.0 * k)
        belief.weigh(measured(belief, 4))
    assert belief.weight.argmax() == 4 and belief.weight[4] > 0.5
    assert belief.tip_spread()[0] < 0.8 * wide[0]
    best, share = belief.likeliest()
    assert 4 in best and share.sum() == pytest.approx(1.0) and best[share.argmax()] == 4


def test_simulated_wires_slide_in_a_vessel_that_beats_as_far_as_that_is_known(side_branch) -> None:
    """One is as the real wire, and driven likewise."""
    beat, same = motion_named("heartbeat"), [World()]
    true = start_world(side_branch, World(), QUICK.belief.core, motion=beat)
    knows, knows_not = (Belief(replace(side_branch, known_motion=known), same, QUICK.belief) for known in (beat, None))
    errors = []
    for _ in range(8):
        true.step([[6.0, 0.0]], 0.5)
        for belief in (knows, knows_not):
            belief.follow(((float(true.inserted_length[0, 0]), 0.0),))
        errors.append(
            [float(abs(belief.tip.abscissa - true.project().abscissa[:, 0])[0]) for belief in (knows, knows_not)]
        )
    assert np.max(errors, axis=0)[0] < 0.01
    assert np.max(errors, axis=0)[1] > 0.3


def test_an_unsure_measurement_weighs_little(side_branch) -> None:
    """The scales of the weights are no smaller than the standard deviations that the detector states."""
    config = BeliefConfig(members=6, time_step_s=0.05, ostium_spread_mm=2.0)
    sure, unsure = (Belief(side_branch, Belief.around(config), config) for _ in range(2))
    sure.weigh(replace(measured(sure, 4), covariance=1e-4 * np.eye(3)))
    unsure.weigh(replace(measured(unsure, 4), covariance=2500.0 * np.eye(3)))
    assert np.ptp(sure.weight) > 0.1 > 0.01 > np.ptp(unsure.weight)
