"""The trials and the training of the network that turns a wire."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.agent import turn_network
from benchmarks.agent.turn_network import TURNS, Forks, fit
from endopilot.control.turn_network import AZIMUTH, FEATURES, ForkView
from endopilot.tasks.navigation import Navigation, Target

pytest.importorskip("torch")


def test_trials_before_a_fork_pass_on_some_sides_and_not_on_others(fork, wire) -> None:
    shaped = replace(wire.with_tip(bend_rad=np.deg2rad(70.0), stiffness_factor=1.0), tip_bend_length_mm=4.0)
    navigation = Navigation(anatomy=fork, device=shaped, target=Target(branch=2, abscissa=33.0), seconds=40.0)
    rows = Forks(navigation, np.random.default_rng(0)).drive()
    view, azimuth, passed = (np.array(column) for column in zip(*rows, strict=True))
    assert view.shape == (len(rows), FEATURES) and azimuth.shape == passed.shape == (len(rows), TURNS)
    before_fork = passed[0]
    assert before_fork.any() and not before_fork.all()
    # A wire that looks to the branch, at azimuth 0, passes rather than one that looks away.
    assert np.cos(azimuth[0][before_fork]).mean() > np.cos(azimuth[0][~before_fork]).mean() + 0.5


def test_the_network_learns_which_sides_pass(monkeypatch) -> None:
    """Sides within 1 rad of what the features say pass: the network finds them at forks it has not seen."""
    for name, few in (("EPOCHS", 25), ("NETWORKS", 1), ("WIDTH", 48)):
        monkeypatch.setattr(turn_network, name, few)
    random = np.random.default_rng(0)
    angle = random.uniform(-np.pi, np.pi, 400)
    view = 0.1 * random.standard_normal((400, FEATURES))
    view[:, 1], view[:, 2] = np.cos(angle), np.sin(angle)  # side and normal of a point of the route
    azimuth = 2 * np.pi * (np.arange(TURNS) / TURNS - 0.5) + np.zeros((400, 1))
    passed = np.cos(azimuth - angle[:, None]) > np.cos(1.0)
    network = fit(view[:300], azimuth[:300], passed[:300])
    best = [AZIMUTH[int(np.argmax(network.passes(ForkView(each, 0.0))))] for each in view[300:]]
    assert np.mean(np.cos(best - angle[300:]) > np.cos(1.0)) > 0.9
