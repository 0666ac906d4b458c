"""Open-loop rollouts: what is given, what is fed back, and that something was learnt."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from endopilot.dataset.loader import read_dataset
from endopilot.devices.drive_limits import DriveLimits
from endopilot.errors import InputError
from endopilot.models.checkpoint import load_model
from endopilot.models.config import TrainConfig, TransformerConfig
from endopilot.models.episodes import Episodes
from endopilot.models.paper import ForwardNetwork, InverseNetwork, TransformerPredictor
from endopilot.models.train import train
from toy_navigation import make_toy_dataset

GIVEN = 30
SMALL = TransformerConfig(d_model=24, heads=2, encoder_layers=1, decoder_layers=1, feedforward=32)


@pytest.fixture(scope="module")
def episodes(toy_dataset):
    """Return navigations of patients that were not trained on."""
    return Episodes.of_dataset(read_dataset(toy_dataset).of_split("test")[:6])


def untrained(limits=(1e9, 1e9)) -> TransformerPredictor:
    torch.manual_seed(1)
    networks = ForwardNetwork(SMALL).eval(), InverseNetwork(SMALL).eval()
    for network in networks:
        torch.nn.init.normal_(network.head.weight, std=0.1)
    return TransformerPredictor(
        *networks, limits=DriveLimits(max_velocity_mm_s=limits[0], max_rotation_rad_s=limits[1])
    )


def driven(episodes, result):
    """Return Δ (mm) and φ (rad) after the given states, the integral of controls."""
    return episodes.proximal[:, GIVEN - 1 : GIVEN].astype(float) + 0.5 * np.cumsum(result.control, axis=1)


def changed(episodes, value, samples, *names):
    """Return the episodes with another value in some samples of the named fields."""
    copies = {name: getattr(episodes, name).copy() for name in names}
    for copy in copies.values():
        copy[:, samples] = value
    return replace(episodes, **copies)


def test_forward_reads_no_tip_after_the_given_ones(episodes):
    blind = changed(episodes, np.nan, slice(GIVEN, None), "tip")
    predictor = untrained()
    np.testing.assert_array_equal(predictor.rollout_forward(episodes).tip, predictor.rollout_forward(blind).tip)


@pytest.mark.parametrize(
    ("protocol", "predicted", "names"),
    [("rollout_forward", "tip", ("control", "proximal")), ("rollout_inverse", "control", ("tip",))],
)
@pytest.mark.parametrize("k", [30, 77])
def test_predictions_do_not_depend_on_what_comes_later(episodes, protocol, predicted, names, k):
    rollout = getattr(untrained(), protocol)
    cut = changed(episodes, np.nan, slice(k + 1, None), *names)
    whole, partial = (getattr(rollout(each), predicted) for each in (episodes, cut))
    np.testing.assert_array_equal(whole[:, : k + 1 - GIVEN], partial[:, : k + 1 - GIVEN])


@pytest.mark.parametrize("protocol", ["rollout_inverse", "rollout_dual"])
def test_inverse_reads_no_motion_after_the_given_ones(episodes, protocol):
    blind = changed(episodes, np.nan, slice(GIVEN, None), "control", "proximal")
    rollout = getattr(untrained(), protocol)
    result = rollout(episodes)
    np.testing.assert_array_equal(result.control, rollout(blind).control)


def test_dual_feeds_the_predicted_tip_back(episodes):
    predictor = untrained()
    dual, inverse = predictor.rollout_dual(episodes), predictor.rollout_inverse(episodes)
    np.testing.assert_array_equal(dual.control[:, 0], inverse.control[:, 0])
    assert np.abs(dual.control[:, 5:] - inverse.control[:, 5:]).max() > 1e-4
    along = replace(
        episodes,
        control=np.concatenate([episodes.control[:, :GIVEN], dual.control], axis=1),
        proximal=np.concatenate([episodes.proximal[:, :GIVEN], driven(episodes, dual)], axis=1),
    )
    np.testing.assert_allclose(predictor.rollout_forward(along).tip, dual.tip, atol=1e-3)
    in_batches = replace(predictor, batch_size=4).rollout_dual(episodes)
    np.testing.assert_allclose(in_batches.tip, dual.tip, atol=1e-3)


def test_controls_stay_within_the_device_s_limits_and_in_the_catheter(episodes):
    result = untrained((0.7, 0.2)).rollout_inverse(episodes)
    assert np.abs(result.control[..., 0]).max() == pytest.approx(0.7)
    assert np.abs(result.control[..., 1]).max() == pytest.approx(0.2)
    outward = np.stack([3.0 * np.arange(120), np.zeros(120)], axis=-1).astype(np.float32)
    away = replace(episodes, tip=episodes.tip - outward)
    inserted = driven(away, untrained().rollout_inverse(away))[..., 0]
    assert inserted.min() > -1e-4
    assert (inserted < 1e-3).any()


def test_a_missing_network_is_named(episodes):
    with pytest.raises(InputError, match="no inverse network; train it with --network both"):
        replace(untrained(), inverse=None).rollout_dual(episodes)


def test_both_networks_learn_what_holds_in_new_patients(toy_dataset, tmp_path):
    config = TrainConfig(epochs=6, windows_per_epoch=2000, batch_size=32, learning_rate=3e-3, size=SMALL)
    train(toy_dataset, output=tmp_path / "run", config=config)
    learnt = load_model(tmp_path / "run")
    episodes = Episodes.of_dataset(read_dataset(toy_dataset).of_split("test")[:16])
    length, truth = episodes.proximal[..., 0], episodes.tip[:, GIVEN:].astype(float)
    slack = length - episodes.tip[..., 0]
    held = length[:, GIVEN:] - slack[:, GIVEN - 1 : GIVEN]
    error = np.abs(learnt.rollout_forward(episodes).tip - truth)
    assert error[..., 0].mean() < 0.7 * np.abs(held - truth[..., 0]).mean()

    truth = episodes.control[:, GIVEN:, 0]
    error = np.abs(learnt.rollout_inverse(episodes).control[..., 0] - truth).mean()
    mean = read_dataset(toy_dataset).of_split("train").control[..., 0].mean()
    assert error < 0.5 * np.abs(episodes.control[:, GIVEN - 1 : GIVEN, 0] - truth).mean()
    assert error < 0.5 * np.abs(mean - truth).mean()


@pytest.fixture(scope="module")
def dataset(toy_dataset):
    return read_dataset(toy_dataset)


def test_a_dataset_gives_its_navigations_to_the_bit(dataset):
    slip = np.random.default_rng(1).uniform(0, 1, dataset.slip.shape).astype(np.float32)
    asked = dataset.control + np.stack([slip, np.zeros_like(slip)], axis=-1) / dataset.sample_period_s
    slipped = replace(dataset, slip=slip, command=asked.astype(float) + 1e-9)  # with digits that float32 lacks
    episodes = Episodes.of_dataset(slipped)
    assert len(episodes) == len(dataset) and episodes.tip.shape[1] == 120
    np.testing.assert_array_equal(episodes.proximal[..., 0], dataset.inserted_length[:, :, 0])
    np.testing.assert_array_equal(episodes.proximal[..., 1], dataset.rotation[:, :, 0])
    np.testing.assert_array_equal(episodes.tip[..., 0], dataset.tip_abscissa[:, :, 0])
    np.testing.assert_array_equal(episodes.tip[..., 1], dataset.tip_offset[:, :, 0])
    np.testing.assert_array_equal(episodes.command, slipped.command)
    np.testing.assert_array_equal(episodes.start, dataset.initial)
    assert np.abs(episodes.command[:, :, 0] - episodes.control).max() > 1.0
    names = set(dataset.anatomy.tolist())
    assert names == set(episodes.anatomies)
    assert all(episodes.anatomies[name]().name == name for name in names)
    some = episodes.select(np.array([3, 1]))
    assert some.anatomies is episodes.anatomies and some.anatomy.tolist() == [episodes.anatomy[3], episodes.anatomy[1]]
    np.testing.assert_array_equal(some.tip, episodes.tip[[3, 1]])


def test_planned_controls_are_made_exactly(fork, wire):
    control = np.random.default_rng(0).normal(size=(2, 5, 2))
    given = {"initial": np.array([2.0, 0.5]), "control": control, "tip": np.zeros((2, 5, 2))}
    episodes = Episodes.of_controls(fork, wire, **given)
    np.testing.assert_allclose(episodes.proximal[:, -1], [2.0, 0.5] + 0.5 * control.sum(axis=1))
    np.testing.assert_array_equal(episodes.command[:, :, 0], control)
    assert episodes.anatomy.tolist() == [fork.name] * 2 and episodes.anatomies[fork.name]() is fork


def test_episodes_no_longer_than_the_given_states_are_refused(tmp_path):
    make_toy_dataset(tmp_path / "d", patients=1, sequences=2, seconds=15.0)
    with pytest.raises(InputError, match=r"30 samples leave nothing to predict .* seconds of 15\.5 or more"):
        Episodes.of_dataset(read_dataset(tmp_path / "d"))
