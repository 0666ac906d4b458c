"""The twin: which parameters it identifies from the given tips, and how well it then predicts and tracks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from endopilot.anatomy.io import read_anatomy, write_anatomy
from endopilot.atlas.atlas import AtlasConfig, make_patient
from endopilot.dataset.config import DatasetConfig
from endopilot.dataset.generate import generate_dataset
from endopilot.dataset.loader import read_dataset
from endopilot.devices.device import read_wire
from endopilot.errors import InputError
from endopilot.models import twin as twin_module
from endopilot.models.checkpoint import load_model
from endopilot.models.config import TrainConfig, TwinConfig
from endopilot.models.ensemble import Ensemble
from endopilot.models.episodes import Episodes
from endopilot.models.simulated_wires import FRICTION_FACTORS
from endopilot.models.train import train
from endopilot.simulation.simulate import simulate

GIVEN = np.arange(45) < 30
OSTIUM_MM = 0.3


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return the folder of a twin's run, whose wires have 14 to 20 % more friction than the nominal device."""
    folder = tmp_path_factory.mktemp("twin")
    anatomy = make_patient(AtlasConfig(seed=77), 0)
    write_anatomy(anatomy, output=folder / "anatomy")
    config = DatasetConfig(sequences=4, seconds=22.5, friction=(0.114, 0.12), seed=3)
    generate_dataset([folder / "anatomy"], output=folder / "dataset", device=read_wire("workhorse-014"), config=config)
    train(folder / "dataset", output=folder / "run", config=TrainConfig(model="twin", twin=TwinConfig(members=12)))
    return folder


@pytest.fixture(scope="module")
def episodes(folder):
    """Return navigations whose ostium lies 0.3 mm deeper than the predictor is given it."""
    true = Episodes.of_dataset(read_dataset(folder / "dataset"))
    error = np.array([OSTIUM_MM, 0.0], dtype=true.proximal.dtype)
    return replace(true, initial=true.initial - error, proximal=true.proximal - error)


@pytest.fixture(scope="module")
def twin(folder):
    """Return the twin."""
    return load_model(folder / "run")


@pytest.fixture(scope="module")
def found(twin, episodes):
    """Return what the twin predicts from the given tips."""
    twin.rollout_forward(episodes)
    return twin.predicted[episodes]


def test_identified_from_the_given_tips_it_predicts_the_others(folder, twin, episodes, found) -> None:
    later = slice(30, None)
    error = np.abs(found.tip - episodes.tip)[:, later]
    anatomy = read_anatomy(folder / "anatomy")
    control = episodes.control.astype(float)
    drawn_out = -0.5 * np.cumsum(control[..., 0], axis=1).min(axis=1)
    start = np.column_stack([np.maximum(episodes.initial[:, 0], drawn_out), episodes.initial[:, 1]])
    nominal = simulate(anatomy, twin.device, control, initial=start).tip.abscissa[:, later, 0]
    nominal_error = np.abs(nominal - episodes.tip[:, later, 0])
    # of the middle navigation: where a snap falls on the other side of its edge, one of four errs by a millimetre
    assert np.median(error[..., 0].mean(axis=1)) < 0.1  # mm
    assert np.median(error[..., 0].mean(axis=1)) < 0.35 * np.median(nominal_error.mean(axis=1))
    assert error[..., 1].mean() < 0.03
    assert np.median(np.abs(found.parameters[:, 2] - OSTIUM_MM)) < 0.1
    # a tip that is not observed is not read
    blind = replace(episodes, tip=episodes.tip.copy())
    blind.tip[:, later] = np.nan
    np.testing.assert_array_equal(twin.predict(blind.select(np.array([1])), GIVEN).tip[0], found.tip[1])


def test_members_that_err_alike_have_a_wide_spread(twin, episodes, found) -> None:
    few, one = (episodes.select(np.arange(count)) for count in (2, 1))
    elsewhere, once = few.tip.copy(), one.tip.copy()
    elsewhere[0, :, 0] += 30.0  # whatever friction, stiffness and ostium
    once[0, 29, 0] += 30.0  # a measurement that went wrong
    doubtful = twin.predict(replace(few, tip=elsewhere), GIVEN).spread
    assert (doubtful[0, 30:, 0] > 20.0).all()
    np.testing.assert_array_equal(doubtful[1], found.spread[1])
    assert twin.predict(replace(one, tip=once), GIVEN).spread[0, 30:].max() < 5.0


def test_a_wire_that_is_held_while_it_is_pulled_starts_where_it_lies(twin, episodes, monkeypatch) -> None:
    """What a drive was commanded and did not make moves no wire: the sum of commands says nothing of where it began."""
    starts = []

    class Kept(Ensemble):
        def __init__(self, *args, **kwargs):
            super().__init__(*args, **kwargs)
            starts.append(self.set_up.initial[:, 0, 0])

    monkeypatch.setattr(twin_module, "Ensemble", Kept)
    held = replace(episodes, command=episodes.command - np.array([10.0, 0.0]))
    twin.predict(held.select(np.array([0])), GIVEN)
    assert np.abs(np.concatenate(starts) - held.initial[0, 0]).max() <= twin.config.ostium_spread_mm + 1e-6


def test_in_a_patient_who_moves_its_wires_move_as_far_as_is_known(folder, twin, tmp_path) -> None:
    config = DatasetConfig(sequences=2, seconds=22.5, seed=4, motion="both")
    generate_dataset([folder / "anatomy"], output=tmp_path / "moving", device=read_wire("workhorse-014"), config=config)
    moving = Episodes.of_dataset(read_dataset(tmp_path / "moving"))
    blind = replace(moving, setup=replace(moving.setup, known_motions={}))
    later = slice(30, None)

    def error(tip: np.ndarray) -> float:
        return float(np.abs(tip[:, later, 0] - moving.tip[: len(tip), later, 0]).mean())

    aware, unaware = (error(twin.predict(episodes, GIVEN).tip) for episodes in (moving, blind))
    assert aware < 0.5 * unaware, (aware, unaware)
    # so do the wires that the causal network starts from, as far as the given tips show the patient's own motion
    packaged = load_model("pretrained")
    seen, middle = np.tile(GIVEN, (len(moving), 1)), FRICTION_FACTORS.index(1.0)
    fitted, mean = (error(packaged.wires.tips(moving, each).tip[:, :, middle]) for each in (seen, np.zeros_like(seen)))
    assert fitted < 0.3 * mean, (fitted, mean)
    # and the network, which was trained in vessels at rest, goes on from there
    assert error(packaged.predict(moving, GIVEN).tip) < 0.1  # mm


def test_it_finds_controls_that_lead_the_tip_along(twin, episodes) -> None:
    found = twin.rollout_dual(episodes)
    later = slice(30, None)
    assert np.abs(found.tip - episodes.tip[:, later])[..., 0].mean() < 0.4  # mm
    # the controls are what the drive does: their integral is its state
    given = episodes.proximal[:, 29:30].astype(float)
    np.testing.assert_allclose(given + 0.5 * np.cumsum(found.control, axis=1), found.proximal, atol=1e-9)
    assert (np.abs(found.control) <= [twin.device.max_velocity_mm_s, twin.device.max_rotation_rad_s]).all()
    # and not those that were recorded
    assert np.abs(found.control - episodes.control[:, later]).mean() > 0.1


def test_under_way_it_drives_on_from_what_was_driven(twin, episodes) -> None:
    few, now = episodes.select(np.array([0])), 37
    observed = GIVEN.copy()
    observed[now] = True
    found = twin.rollout_dual(few, observed)
    assert np.abs(found.tip - few.tip[:, now + 1 :])[..., 0].mean() < 0.4  # mm
    start = few.proximal[:, now].astype(float)
    np.testing.assert_allclose(found.proximal[:, 0], start + 0.5 * found.control[:, 0], atol=1e-9)


def test_all_protocols_share_one_ensemble_and_one_search(folder, episodes, monkeypatch) -> None:
    calls = {"Ensemble": 0, "track": 0}

    def counted(name):
        real = getattr(twin_module, name)

        def called(*args, **kwargs):
            calls[name] += 1
            return real(*args, **kwargs)

        return called

    for name in calls:
        monkeypatch.setattr(twin_module, name, counted(name))
    few = episodes.select(np.array([0]))
    twin = load_model(folder / "run")
    forward = twin.rollout_forward(few)
    simulated = calls["Ensemble"]
    inverse, dual = twin.rollout_inverse(few), twin.rollout_dual(few)
    assert simulated > 0 and calls == {"Ensemble": simulated, "track": 1}
    np.testing.assert_array_equal(inverse.control, dual.control)
    # other episodes are not taken for these
    other = twin.rollout_forward(episodes.select(np.array([1])))
    assert np.abs(other.tip - forward.tip).max() > 0.1


def test_refuses_bad_settings() -> None:
    for change, message in (
        ({"members": 0}, "members: 0"),
        ({"friction_spread": 1.5}, "friction_spread: 1.5"),
        ({"ostium_spread_mm": -1.0}, "ostium_spread_mm: -1.0"),
        ({"abscissa_sd_mm": 0.0}, "abscissa_sd_mm: 0.0"),
    ):
        with pytest.raises(InputError, match=message):
            TwinConfig(**change)
