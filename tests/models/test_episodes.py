"""What a predictor is given of navigations: by a dataset, by a plan, and by a navigation under way."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from endopilot.dataset.loader import read_dataset
from endopilot.errors import InputError
from endopilot.models import patient
from endopilot.models.checkpoint import load_model
from endopilot.models.episodes import PATIENTS_FOLDER, Episodes, EpisodeSetUp, given_states
from endopilot.simulation.config import SimulatorConfig
from toy_navigation import make_toy_dataset


@pytest.fixture(scope="module")
def dataset(toy_dataset):
    return read_dataset(toy_dataset)


def test_a_dataset_gives_its_navigations_to_the_bit(dataset):
    slip = np.random.default_rng(1).uniform(0, 1, dataset.slip.shape).astype(np.float32)
    asked = dataset.control + np.stack([slip, np.zeros_like(slip)], axis=-1) / dataset.sample_period_s
    slipped = replace(dataset, slip=slip, command=asked.astype(float) + 1e-9)  # with digits that float32 lacks
    episodes = Episodes.of_dataset(slipped)
    assert len(episodes) == len(dataset) and episodes.samples == 120
    np.testing.assert_array_equal(episodes.proximal[..., 0], dataset.inserted_length[:, :, 0])
    np.testing.assert_array_equal(episodes.proximal[..., 1], dataset.rotation[:, :, 0])
    np.testing.assert_array_equal(episodes.tip[..., 0], dataset.tip_abscissa[:, :, 0])
    np.testing.assert_array_equal(episodes.tip[..., 1], dataset.tip_offset[:, :, 0])
    np.testing.assert_array_equal(episodes.initial, dataset.initial[:, 0])
    np.testing.assert_array_equal(episodes.command, slipped.command[:, :, 0])
    assert np.abs(episodes.command - episodes.control).max() > 1.0
    names = set(dataset.anatomy.tolist())
    assert names == set(episodes.setup.anatomies) == set(episodes.setup.identities)
    assert all(episodes.setup.anatomies[name]().name == name for name in names)


def test_chosen_episodes_share_the_setup(dataset):
    episodes = Episodes.of_dataset(dataset)
    some = episodes.select(np.array([3, 1]))
    assert some.setup is episodes.setup and some.anatomy.tolist() == [episodes.anatomy[3], episodes.anatomy[1]]
    np.testing.assert_array_equal(some.branch, episodes.branch[[3, 1]])


def test_episodes_from_a_sample_on_begin_at_the_state_before_it(dataset):
    episodes = Episodes.of_dataset(dataset)
    later = episodes.from_sample(40)
    np.testing.assert_array_equal(later.initial, episodes.proximal[:, 39])
    for name in ("control", "command", "proximal", "tip", "branch", "tip_sd"):
        np.testing.assert_array_equal(getattr(later, name), getattr(episodes, name)[:, 40:])
    assert episodes.from_sample(0) is episodes


def test_another_motion_of_the_drive_changes_the_last_samples_alone(dataset):
    episodes = Episodes.of_dataset(dataset)
    moved = np.full((len(episodes), 7, 2), 3.0)
    other = episodes.driven(moved, 2 * moved)
    np.testing.assert_array_equal(other.proximal[:, :-7], episodes.proximal[:, :-7])
    assert (other.proximal[:, -7:] == 3.0).all() and (other.control[:, -7:] == 6.0).all()
    np.testing.assert_array_equal(other.command[:, :-7], episodes.command[:, :-7])
    assert (other.command[:, -7:] == 6.0).all()  # nothing of how the drive slipped in the recorded motion
    np.testing.assert_array_equal(other.tip, episodes.tip)


def test_planned_controls_are_made_exactly(fork, wire):
    control = np.random.default_rng(0).normal(size=(2, 5, 2))
    setup = EpisodeSetUp.of_anatomy(fork, wire, SimulatorConfig())
    episodes = Episodes.of_controls(setup, initial=np.array([2.0, 0.5]), control=control, tip=np.zeros((2, 5, 2)))
    np.testing.assert_allclose(episodes.proximal[:, -1], [2.0, 0.5] + 0.5 * control.sum(axis=1))
    np.testing.assert_array_equal(episodes.command, control)
    assert episodes.anatomy.tolist() == [fork.name] * 2 and episodes.setup.anatomies[fork.name]() is fork


def test_a_vessel_in_memory_needs_no_folder_and_is_prepared_once(fork, wire, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    prepared = []
    real = patient.prepare
    monkeypatch.setattr("endopilot.models.episodes.prepare", lambda *args: prepared.append(args) or real(*args))
    control = np.tile([1.0, 0.0], (1, 40, 1))
    tip = np.tile([2.0, 0.1], (1, 40, 1))
    setup = EpisodeSetUp.of_anatomy(fork, wire, SimulatorConfig(threads=1))
    episodes = Episodes.of_controls(setup, initial=np.array([2.0, 0.0]), control=control, tip=tip)
    predictor = load_model(Path("pretrained"))
    found = predictor.predict(episodes, given_states(episodes))
    again = predictor.predict(episodes.select(np.array([0])), given_states(episodes))
    assert np.isfinite(found.tip).all() and len(prepared) == 1
    np.testing.assert_array_equal(again.tip, found.tip)
    assert not list(tmp_path.iterdir())


def test_a_dataset_keeps_its_prepared_patients(dataset, fork, wire, monkeypatch, tmp_path):
    made, one = [], patient.prepare(fork, wire, SimulatorConfig(threads=1))

    def prepare(anatomy, device, config):
        made.append(anatomy.name)
        return one

    monkeypatch.setattr(patient, "prepare", prepare)
    setup = replace(EpisodeSetUp.of_dataset(dataset), patients_folder=tmp_path / PATIENTS_FOLDER)
    name = str(dataset.anatomy[0])
    for _ in range(2):
        np.testing.assert_array_equal(setup.patient(name).push_tip, one.push_tip)
    assert made == [name]
    replace(setup, identities={name: "of another vessel with this name"}).patient(name)
    replace(setup, simulator=replace(setup.simulator, element_mm=1.0)).patient(name)
    assert made == [name] * 3 and len(list((tmp_path / PATIENTS_FOLDER).iterdir())) == 3


def test_episodes_no_longer_than_the_given_states_are_refused(tmp_path):
    make_toy_dataset(tmp_path / "d", patients=1, sequences=2, seconds=15.0)
    with pytest.raises(InputError, match=r"30 samples leave nothing to predict .* seconds of 15\.5 or more"):
        Episodes.of_dataset(read_dataset(tmp_path / "d"))
