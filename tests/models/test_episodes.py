"""What a predictor is given of navigations: by a dataset, by a plan, and by a navigation under way."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from endopilot.dataset.loader import read_dataset
from endopilot.errors import InputError
from endopilot.models.episodes import Episodes
from toy_navigation import make_toy_dataset


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
