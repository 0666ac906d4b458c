"""Our networks: what they must not see, what they must take in, and what the packaged pair reaches on new patients."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from endopilot.anatomy.io import write_anatomy
from endopilot.atlas.atlas import AtlasConfig, make_patient
from endopilot.dataset.generate import DatasetConfig, generate_dataset
from endopilot.dataset.loader import load_dataset
from endopilot.errors import InputError
from endopilot.evaluation.prediction_baselines import follow_slack, hold_slack, mean_control
from endopilot.files import read_json, sha256
from endopilot.models.causal import CausalNetwork, CausalPredictor
from endopilot.models.config import CausalConfig, TrainConfig
from endopilot.models.open_loop import Predictor, ProbabilisticPredictor
from endopilot.models.play import N_FEATURES, mirrored
from endopilot.models.rollout import load_model
from endopilot.models.sequences import N_INPUTS, Sequences, read_vessels, unfold
from endopilot.models.train import train
from endopilot.simulation.device import read_device
from endopilot.simulation.drive_limits import DriveLimits

GIVEN = 30
SMALL = CausalConfig(width=8)
SHORT = TrainConfig(model="causal", network="ff", epochs=2, batch_size=4, causal=SMALL)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return a dataset of two patients that the packaged networks have not seen: one trains, one tests."""
    folder = tmp_path_factory.mktemp("causal")
    patients = []
    for index in range(2):
        anatomy = make_patient(AtlasConfig(seed=910), index)
        patients.append(folder / anatomy.name)
        write_anatomy(anatomy, patients[-1])
    config = DatasetConfig(sequences=4, seconds=37.5, anatomy_shares=(0.5, 0.0, 0.5), seed=4)
    generate_dataset(patients, folder / "dataset", read_device("workhorse-014"), config)
    return folder / "dataset"


@pytest.fixture(scope="module")
def everyone(folder):
    """Return the navigations of both patients."""
    return load_dataset(folder)


@pytest.fixture(scope="module")
def brief(everyone):
    """Return them cut off after 22.5 s, where what counts is that nothing later is looked at."""
    arrays = {f.name: getattr(everyone, f.name) for f in fields(everyone)}
    return replace(everyone, **{name: a[:, :45] for name, a in arrays.items() if getattr(a, "ndim", 0) > 1})


@pytest.fixture(scope="module")
def packaged():
    return load_model(Path("pretrained"))


def untrained() -> CausalPredictor:
    torch.manual_seed(1)
    networks = CausalNetwork(SMALL).eval(), CausalNetwork(SMALL).eval()
    for network in networks:
        torch.nn.init.normal_(network.output.weight, std=0.5)
    return CausalPredictor(*networks, limits=DriveLimits(max_velocity_mm_s=40.0, max_rotation_rad_s=12.6))


def given(episodes) -> np.ndarray:
    return np.arange(episodes.valid.shape[1]) < GIVEN


def miss(tip, episodes) -> np.ndarray:
    return np.abs(tip - np.stack([episodes.tip_abscissa, episodes.tip_offset], axis=-1)[:, GIVEN:])


def test_the_packaged_pair_beats_holding_slack_and_offset_on_new_patients(packaged, everyone):
    assert isinstance(packaged, Predictor) and isinstance(packaged, ProbabilisticPredictor)
    ours, held = miss(packaged.rollout_forward(everyone).tip, everyone), miss(hold_slack(everyone, GIVEN), everyone)
    assert ours[..., 0].mean() < 0.35 * held[..., 0].mean()
    assert np.median(ours[..., 0]) < 0.15  # mm
    assert ours[..., 1].mean() < 0.5 * held[..., 1].mean()


def test_the_packaged_pair_knows_how_sure_it_is(packaged, everyone):
    told = packaged.foretell(everyone, given(everyone))
    off, spread = miss(told.tip[:, GIVEN:], everyone)[..., 0], told.spread[:, GIVEN:, 0]
    unsure = spread > np.median(spread)
    assert off[unsure].mean() > 1.5 * off[~unsure].mean()
    assert (told.spread[:, :GIVEN] == 0).all()


def test_the_packaged_inverse_beats_the_mean_and_the_held_slack(packaged, everyone):
    truth = everyone.control[:, GIVEN:, 0]

    def rmse(control):
        return np.sqrt(((control[..., 0] - truth) ** 2).mean())

    ours = rmse(packaged.rollout_inverse(everyone).control)
    assert ours < rmse(follow_slack(everyone, GIVEN))
    assert ours < 0.6 * rmse(mean_control(everyone, everyone, GIVEN))


def test_the_loop_of_both_leads_the_foretold_tip_along(packaged, everyone):
    found = packaged.rollout_dual(everyone)
    start = np.stack([everyone.inserted_length, everyone.rotation], axis=-1)[:, GIVEN - 1 : GIVEN].astype(float)
    np.testing.assert_allclose(found.proximal, start + 0.5 * np.cumsum(found.control, axis=1), atol=1e-9)
    assert (np.abs(found.control) <= packaged.limits.fastest).all()
    assert found.proximal[..., 0].min() > -1e-6
    assert miss(found.tip, everyone)[..., 0].mean() < 0.4  # mm


@pytest.mark.parametrize("k", [30, 43])
def test_a_later_control_changes_no_earlier_prediction(brief, k):
    length, rotation = brief.inserted_length.copy(), brief.rotation.copy()
    length[:, k + 1 :] += 3.0
    rotation[:, k + 1 :] += 1.0
    other = replace(brief, inserted_length=length, rotation=rotation)
    seen = given(brief)
    before, after = (untrained().foretell(episodes, seen) for episodes in (brief, other))
    np.testing.assert_array_equal(before.tip[:, : k + 1], after.tip[:, : k + 1])
    np.testing.assert_array_equal(before.spread[:, : k + 1], after.spread[:, : k + 1])
    assert np.abs(before.tip[:, k + 1] - after.tip[:, k + 1]).max() > 0.1


def test_a_tip_that_is_not_seen_is_not_looked_at_and_one_that_is_counts(brief):
    blind = replace(brief, tip_abscissa=brief.tip_abscissa.copy(), tip_offset=brief.tip_offset.copy())
    blind.tip_abscissa[:, GIVEN:] = blind.tip_offset[:, GIVEN:] = np.nan
    predictor, seen = untrained(), given(brief)
    told = predictor.foretell(brief, seen)
    np.testing.assert_array_equal(predictor.foretell(blind, seen).tip, told.tip)
    later = seen.copy()
    later[36] = True
    more = predictor.foretell(brief, later)
    np.testing.assert_array_equal(more.tip[:, :36], told.tip[:, :36])
    np.testing.assert_array_equal(more.tip[:, 36, 0], brief.tip_abscissa[:, 36].astype(float))
    assert np.abs(more.tip[:, 37:] - told.tip[:, 37:]).max() > 0.01


def test_what_is_seen_of_one_navigation_changes_no_other_one(brief):
    predictor, seen = untrained(), np.tile(given(brief), (len(brief), 1))
    told = predictor.foretell(brief, seen)
    seen[1, 36] = True
    more = predictor.foretell(brief, seen)
    np.testing.assert_array_equal(more.tip[2:], told.tip[2:])
    assert np.abs(more.tip[1, 37:] - told.tip[1, 37:]).max() > 0.01


def test_some_navigations_are_foretold_as_they_are_among_all(brief):
    predictor = untrained()
    told, last = predictor.foretell(brief, given(brief)), np.array([len(brief) - 1])  # of the second patient
    alone = predictor.foretell(brief.select(last), given(brief))
    np.testing.assert_allclose(alone.tip, told.tip[last], atol=1e-5)
    np.testing.assert_allclose(alone.spread, told.spread[last], atol=1e-5)
    assert len(predictor.known) == 1  # nobody was read again


def test_a_later_x_ray_helps(packaged, everyone):
    seen = given(everyone)
    later = seen.copy()
    later[[45, 55]] = True
    after = slice(56, 70)
    off = [
        np.abs(packaged.foretell(everyone, mask).tip[:, after, 0] - everyone.tip_abscissa[:, after]).mean()
        for mask in (seen, later)
    ]
    assert off[1] < off[0]


@pytest.mark.parametrize("protocol", ["rollout_inverse", "rollout_dual"])
def test_inverse_sees_no_later_motion_and_no_later_desired_tip(brief, protocol, monkeypatch):
    monkeypatch.setattr("endopilot.models.causal._REFINEMENTS", 1)
    k = 36
    control, length, rotation = brief.control.copy(), brief.inserted_length.copy(), brief.rotation.copy()
    for later in (control, length, rotation):
        later[:, GIVEN:] = 7.0
    tip, offset = brief.tip_abscissa.copy(), brief.tip_offset.copy()
    tip[:, k + 1 :] -= 2.0
    offset[:, k + 1 :] = 0.1
    rollout = getattr(untrained(), protocol)
    whole = rollout(brief).control
    np.testing.assert_array_equal(
        whole, rollout(replace(brief, control=control, inserted_length=length, rotation=rotation)).control
    )
    cut = rollout(replace(brief, tip_abscissa=tip, tip_offset=offset)).control
    np.testing.assert_array_equal(whole[:, : k + 1 - GIVEN], cut[:, : k + 1 - GIVEN])
    assert np.abs(whole - cut).max() > 0.1


def test_a_plan_under_way_begins_where_the_drive_is_and_heeds_what_was_seen(brief, monkeypatch):
    monkeypatch.setattr("endopilot.models.causal._REFINEMENTS", 1)
    now, seen = 37, given(brief)
    seen[now] = True
    predictor = untrained()
    plan = predictor.rollout_dual(brief, seen)
    assert plan.control.shape == (len(brief), brief.valid.shape[1] - now - 1, 2)
    start = np.stack([brief.inserted_length, brief.rotation], axis=-1)[:, now].astype(float)
    np.testing.assert_allclose(plan.proximal[:, 0], start + 0.5 * plan.control[:, 0], atol=1e-9)
    # the drive's later motion is not looked at, its motion since the given states is
    control, length = brief.control.copy(), brief.inserted_length.copy()
    control[:, now + 1 :], length[:, now + 1 :] = 7.0, 7.0
    np.testing.assert_array_equal(
        predictor.rollout_dual(replace(brief, control=control, inserted_length=length), seen).control, plan.control
    )
    length[:, GIVEN : now + 1] += 2.0
    assert np.abs(predictor.rollout_dual(replace(brief, inserted_length=length), seen).tip - plan.tip).max() > 0.1
    # nor is the tip that was seen forgotten: unseen, the same navigation goes on otherwise
    blind = given(brief)
    blind[now - 1] = True
    assert np.abs(predictor.rollout_dual(brief, blind).tip[:, 1:] - plan.tip).max() > 1e-3


def test_the_play_operator_alone_beats_holding_the_slack(everyone):
    patient = np.unique(everyone.anatomy, return_inverse=True)[1]
    seen = np.broadcast_to(given(everyone), everyone.valid.shape)
    guess = unfold("forward", read_vessels(everyone), patient, everyone, seen).guess[:, GIVEN:]
    held = miss(hold_slack(everyone, GIVEN), everyone)[..., 0]
    assert miss(guess, everyone)[..., 0].mean() < 0.5 * held.mean()


def test_mirrored_vessels_behave_alike(brief):
    assert mirrored().shape == (N_FEATURES,)
    vessels = read_vessels(brief)
    forms = Sequences.of(brief, vessels, ("ff",), 0)
    inputs, change = forms.window("ff", torch.tensor([[0, 0], [0, 2]]))
    np.testing.assert_array_equal(change[0], change[1])
    assert (inputs[0] != inputs[1]).any()
    # a vessel in the mirror, with the wire turned the other way, gives the mirrored features
    geometry = vessels.geometry * np.array([-1.0, 1, -1, 1, 1, 1, 1])  # in the plane that the unturned tip bends in

    def flipped(tables):
        return tuple(np.roll(table[:, ::-1], 1, axis=1) for table in tables)

    twin = replace(
        vessels,
        geometry=geometry,
        known={way: flipped(tables) for way, tables in vessels.known.items()},
        clearance=flipped(vessels.clearance),
        deepest=np.roll(vessels.deepest[:, ::-1], 1, axis=1),
        leaf=np.roll(vessels.leaf[:, ::-1], 1, axis=1),
        on_route=np.roll(vessels.on_route[..., ::-1], 1, axis=2),
    )
    turned = replace(brief, rotation=-brief.rotation, initial_rotation=-brief.initial_rotation)
    patient = np.unique(brief.anatomy, return_inverse=True)[1]
    seen = np.broadcast_to(given(brief), brief.valid.shape)
    ours = unfold("forward", vessels, patient, brief, seen).inputs * np.append(
        mirrored(), np.ones(N_INPUTS - N_FEATURES)
    )
    theirs = unfold("forward", twin, patient, turned, seen).inputs
    np.testing.assert_allclose(ours, theirs, atol=2e-3)


def test_a_seed_repeats_to_the_bit_and_an_interrupted_run_goes_on(folder, tmp_path):
    train(folder, tmp_path / "once", SHORT)
    assert read_json(tmp_path / "once/training.json")["ff"]["parameters"] < 10_000

    class Cut(Exception):
        pass

    def stop(self, *args):
        save(self, *args)
        raise Cut

    from endopilot.models.train import Job

    save = Job._save
    with pytest.MonkeyPatch.context() as patch, pytest.raises(Cut):
        patch.setattr(Job, "_save", stop)
        train(folder, tmp_path / "cut", SHORT)
    train(folder, tmp_path / "cut", SHORT)
    assert sha256(tmp_path / "cut/ff.safetensors") == sha256(tmp_path / "once/ff.safetensors")
    assert isinstance(load_model(tmp_path / "cut"), CausalPredictor)


def test_bad_input_is_named(brief, tmp_path):
    with pytest.raises(InputError, match="no inverse network; train it with --network both"):
        replace(untrained(), inverse=None).rollout_dual(brief)
    with pytest.raises(InputError, match=r"^width: 0"):
        CausalConfig(width=0)
    with pytest.raises(InputError, match="no such run; give a folder made by `endopilot train`, or 'pretrained'"):
        load_model(tmp_path / "nothing")
