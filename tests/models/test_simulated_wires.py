"""Simulated wires: what they identify from the tips that were seen, and how well they then predict and track."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from endopilot.dataset.config import DatasetConfig
from endopilot.dataset.generate import generate_dataset
from endopilot.dataset.loader import read_dataset
from endopilot.devices.device import read_wire
from endopilot.devices.stack import Stack
from endopilot.models.checkpoint import load_model
from endopilot.models.episodes import Episodes
from endopilot.models.hypotheses import HYPOTHESES, Family
from endopilot.models.simulated_wires import SimulatedWires, weighted_median, weights
from endopilot.simulation.config import PRESETS

LATER = slice(30, None)
OSTIUM_MM = 0.3


def navigations(vessel, folder, **settings) -> Episodes:
    device = settings.pop("device", read_wire("workhorse-014"))
    config = DatasetConfig(seconds=20.0, seen_test_share=0.0, simulator=PRESETS["fast"], **settings)
    generate_dataset([vessel], output=folder, device=device, config=config)
    return Episodes.of_dataset(read_dataset(folder))


@pytest.fixture(scope="module")
def episodes(vessel, tmp_path_factory):
    """Return navigations with more friction than is given, and an ostium 0.3 mm deeper."""
    folder = tmp_path_factory.mktemp("wires") / "dataset"
    true = navigations(vessel, folder, sequences=3, friction=(0.114, 0.12), seed=3)
    error = np.array([OSTIUM_MM, 0.0], dtype=true.proximal.dtype)
    return replace(true, start=true.start - error, proximal=true.proximal - error)


def error_mm(tip, episodes) -> np.ndarray:
    """Return the mean error of Δtip of each episode after the given states."""
    return np.abs(tip - episodes.tip[:, LATER])[..., 0].mean(axis=1)


def test_identified_from_the_given_tips_they_predict_the_others(episodes):
    """The ostium alone would make an error of 0.3 mm."""
    found = SimulatedWires().rollout_forward(episodes).tip
    # of the middle navigation: where a snap falls on the other side of its edge, one of four errs by a millimetre
    assert np.median(error_mm(found, episodes)) < 0.1
    assert np.abs(found - episodes.tip[:, LATER])[..., 1].mean() < 0.03
    # a tip that is not given is not read
    blind = replace(episodes, tip=episodes.tip.copy()).select(np.array([1]))
    blind.tip[:, LATER] = np.nan
    np.testing.assert_array_equal(SimulatedWires().rollout_forward(blind).tip[0], found[1])


def test_in_a_patient_who_moves_wires_move_as_far_as_is_known(vessel, tmp_path):
    moving = navigations(vessel, tmp_path / "moving", sequences=1, seed=4, motion="both")
    blind = replace(moving, known_motions={})
    fitted, unaware = (error_mm(SimulatedWires().rollout_forward(each).tip, moving).mean() for each in (moving, blind))
    assert fitted < 0.5 * unaware, (fitted, unaware)


def test_a_wire_in_a_catheter_is_predicted_and_led_too(vessel, tmp_path):
    pair = Stack.of("workhorse-014", "microcatheter-1.7f")
    both = navigations(vessel, tmp_path / "pairs", device=pair, sequences=1, seed=5, friction=(0.115, 0.12))
    assert both.start.shape == (1, 2, 2) and both.command.shape == (1, 40, 2, 2)
    wires = SimulatedWires()
    assert np.median(error_mm(wires.rollout_forward(both).tip, both)) < 0.2
    still = replace(both, command=both.command * np.array([[1.0], [0.0]]))  # the catheter stays
    wires.identified[still] = wires.identified[both]  # of the same wires
    assert np.abs(wires.rollout_forward(still).tip - both.tip[:, LATER]).max() > 0.3
    assert np.median(error_mm(wires.rollout_dual(both).tip, both)) < 0.5


def test_they_find_controls_that_lead_the_tip_along(episodes):
    wires = load_model()
    dual = wires.rollout_dual(episodes)
    assert np.abs(dual.tip - episodes.tip[:, LATER])[..., 0].mean() < 0.4  # mm
    device = read_wire("workhorse-014")
    assert (np.abs(dual.control) <= [device.max_velocity_mm_s, device.max_rotation_rad_s]).all()
    # and not those that were recorded
    assert np.abs(dual.control - episodes.control[:, LATER]).mean() > 0.1
    np.testing.assert_array_equal(wires.rollout_inverse(episodes).control, dual.control)


@pytest.fixture(scope="module")
def moved_tips():
    """Return members of two hypotheses, what they show in 20 exposures, and what is shown if the first one is made."""
    friction, ostium = (each for each in HYPOTHESES if each.name in ("another friction", "another ostium"))
    family, random = Family([friction, ostium]), np.random.default_rng(0)
    members = family.drawn(np.zeros(2), np.eye(2), 16, 4)
    slope = random.uniform(0.5, 1.5, (2, 20, 3)) * np.array([[1.0, 0.3, 0.0], [0.0, 0.2, 1.0]])[:, None]
    shown = 1.5 * slope[0] + random.normal(0, 0.1, slope[0].shape)
    shown[::10] += 3.0  # a measurement that went wrong
    return family, members, np.einsum("mp,pna->mna", members, slope), shown, np.full(shown.shape, 0.1)


def test_the_hypothesis_that_explains_the_images_is_the_likeliest_and_its_parameter_is_known(moved_tips):
    family, members, tips, shown, scale = moved_tips
    found = family.update(members, tips, shown, scale)
    assert found.probability[0] > 0.9 and found.probability[1] < 0.5 and found.none < 0.05
    assert found.mean[0] == pytest.approx(1.5, abs=0.1) and found.center[1] == pytest.approx(0.0, abs=0.1)
    low, high = family.interval(found, "friction_factor", 1.28)
    assert low < np.exp(1.5 * 0.6) < high and high / low < 1.2


def test_none_of_the_hypotheses_wins_where_none_explains_the_images(moved_tips):
    family, members, tips, shown, scale = moved_tips
    elsewhere = np.random.default_rng(1).normal(0, 0.6, shown.shape)
    assert family.update(members, tips, elsewhere, scale).none > 0.9
    beside = shown + np.array([0.0, 0.4, 0.0]) * np.resize([1.0, -1.0], 20)[:, None]  # to and fro, which no member does
    assert family.update(members, tips, beside, scale).none > 0.9
    assert family.update(members, tips, tips[5] + (beside - shown)[::-1] / 8, scale).none < 0.5  # by half a deviation
    assert family.update(members, np.full_like(tips, np.nan), shown, scale).none == 1.0


def test_nothing_is_believed_where_nothing_was_seen(moved_tips):
    family, members, tips, shown, scale = moved_tips
    found = family.update(members, tips[:, :0], shown[:0], scale[:0])
    assert not found.center.any() and not found.probability.any()
    np.testing.assert_array_equal(np.diag(found.factor), family.usual)


def test_a_wire_is_as_likely_as_it_retraces_what_was_seen():
    paths, tips = np.array([0.0, 1.0, np.nan])[:, None, None, None] * np.ones((1, 1, 10, 2)), np.full((1, 10, 2), 1.0)
    weight = weights(paths, tips)
    np.testing.assert_allclose(weight[:, 0], [0.0, 1.0, 0.0], atol=1e-6)
    assert (weighted_median(paths, weight) == 1.0).all()
    assert np.isnan(weighted_median(paths[2:], weight[2:])).all()
