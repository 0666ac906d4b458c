"""The causal networks: what they must not read, what they must use, and how the packaged pair does on new patients."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from endopilot.anatomy.io import read_anatomy, write_anatomy
from endopilot.atlas.atlas import AtlasConfig, make_patient
from endopilot.dataset.config import DatasetConfig
from endopilot.dataset.generate import generate_dataset
from endopilot.dataset.loader import Dataset, read_dataset
from endopilot.devices.device import read_wire
from endopilot.devices.drive_limits import DriveLimits
from endopilot.errors import InputError
from endopilot.evaluation.protocols import follow_slack, hold_slack, mean_control
from endopilot.files import read_json, sha256
from endopilot.models.causal import CausalForward, CausalInverse, CausalPredictor, Mixture
from endopilot.models.checkpoint import load_model
from endopilot.models.config import CausalConfig, TrainConfig
from endopilot.models.episodes import JUMP_MM, Episodes, Predictor, ProbabilisticPredictor, jumps
from endopilot.models.fitted_wires import SCALES_MM, SPREADS, posterior, rounded
from endopilot.models.patient import STEP_MM, prepare
from endopilot.models.play import N_FEATURES, mirrored
from endopilot.models.sequences import N_INPUTS, Sequences, play_tables, unfold
from endopilot.models.simulated_wires import FRICTION_FACTORS, SimulatedWires, read_or_simulate, simulated_tips
from endopilot.models.train import train
from endopilot.simulation.config import SimulatorConfig

GIVEN = 30
SMALL = CausalConfig(width=8)
WIRES = SimulatedWires()  # of all tests, which simulates none twice
SHORT = TrainConfig(model="causal", network="ff", epochs=2, batch_size=4, causal=SMALL)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return a dataset of two patients that the packaged networks were not trained on: one trains, one tests."""
    folder = tmp_path_factory.mktemp("causal")
    patients = []
    for index in range(2):
        anatomy = make_patient(AtlasConfig(seed=910), index)
        patients.append(folder / anatomy.name)
        write_anatomy(anatomy, output=patients[-1])
    config = DatasetConfig(sequences=4, seconds=37.5, anatomy_shares=(0.5, 0.0, 0.5), seed=4)
    generate_dataset(patients, output=folder / "dataset", device=read_wire("workhorse-014"), config=config)
    return folder / "dataset"


@pytest.fixture(scope="module")
def dataset(folder) -> Dataset:
    """Return the navigations of both patients as they were recorded."""
    return read_dataset(folder)


@pytest.fixture(scope="module")
def everyone(dataset) -> Episodes:
    """Return them as predictors are given them."""
    return Episodes.of_dataset(dataset)


@pytest.fixture(scope="module")
def brief(everyone) -> Episodes:
    """Return them cut off after 22.5 s, where what counts is that nothing later is read."""
    signals = ("control", "command", "proximal", "tip", "branch", "tip_sd")
    return replace(everyone, **{name: getattr(everyone, name)[:, :45] for name in signals})


@pytest.fixture(scope="module")
def packaged() -> CausalPredictor:
    found = load_model(Path("pretrained"))
    assert isinstance(found, CausalPredictor)
    return replace(found, wires=WIRES)


def untrained() -> CausalPredictor:
    torch.manual_seed(1)
    networks = CausalForward(SMALL).eval(), CausalInverse(SMALL).eval()
    for network in networks:
        torch.nn.init.normal_(network.output.weight, std=0.5)
    limits = DriveLimits(max_velocity_mm_s=40.0, max_rotation_rad_s=12.6)
    return CausalPredictor(*networks, limits=limits, wires=WIRES)


def given(episodes) -> np.ndarray:
    return np.arange(episodes.samples) < GIVEN


def every(episodes) -> np.ndarray:
    return np.tile(given(episodes), (len(episodes), 1))


def each_numbered(episodes, *_) -> np.ndarray:
    """Return tips of wires, in each episode its row."""
    shape = (len(episodes), episodes.samples, len(FRICTION_FACTORS) + 1, 2)
    return np.broadcast_to(np.arange(len(episodes))[:, None, None, None], shape)


def error(tip, episodes) -> np.ndarray:
    return np.abs(tip - episodes.tip[:, GIVEN:])


def changed(episodes, **later):
    """Return the episodes with other values: a name gives the first sample and what is there from it on."""
    copies = {name: getattr(episodes, name).copy() for name in later}
    for name, (first, values) in later.items():
        copies[name][:, first:] = values(copies[name][:, first:]) if callable(values) else values
    return replace(episodes, **copies)


def test_the_packaged_pair_beats_holding_slack_and_offset_on_new_patients(packaged, everyone, dataset):
    assert isinstance(packaged, Predictor) and isinstance(packaged, ProbabilisticPredictor)
    ours, held = error(packaged.rollout_forward(everyone).tip, everyone), error(hold_slack(dataset, GIVEN), everyone)
    assert ours[..., 0].mean() < 0.35 * held[..., 0].mean()
    assert np.median(ours[..., 0]) < 0.15  # mm
    assert ours[..., 1].mean() < 0.5 * held[..., 1].mean()


def test_the_packaged_pair_knows_how_sure_it_is(packaged, everyone):
    found = packaged.predict(everyone, given(everyone))
    absolute, spread = error(found.tip[:, GIVEN:], everyone)[..., 0], found.spread[:, GIVEN:, 0]
    unsure = spread > np.median(spread)
    assert absolute[unsure].mean() > 1.5 * absolute[~unsure].mean()
    assert (found.spread[:, :GIVEN] == 0).all()


def test_the_packaged_inverse_beats_the_mean_and_the_held_slack(packaged, everyone, dataset):
    truth = everyone.control[:, GIVEN:, 0]

    def rmse(control):
        return np.sqrt(((control[..., 0] - truth) ** 2).mean())

    ours = rmse(packaged.rollout_inverse(everyone).control)
    assert ours < rmse(follow_slack(dataset, GIVEN))
    assert ours < 0.6 * rmse(mean_control(dataset, dataset, GIVEN))


def test_the_loop_of_both_leads_the_predicted_tip_along(packaged, everyone):
    everyone = everyone.select(np.arange(0, len(everyone), 2))
    found = packaged.rollout_dual(everyone)
    start = everyone.proximal[:, GIVEN - 1 : GIVEN].astype(float)
    np.testing.assert_allclose(found.proximal, start + 0.5 * np.cumsum(found.control, axis=1), atol=1e-9)
    assert (np.abs(found.control) <= packaged.limits.fastest).all()
    assert found.proximal[..., 0].min() > -1e-6
    assert error(found.tip, everyone)[..., 0].mean() < 0.4  # mm


@pytest.mark.parametrize("k", [30, 43])
def test_a_later_control_changes_no_earlier_prediction(brief, k):
    faster = (k + 1, lambda control: control + np.array([5.0, 1.0]))
    other = changed(brief, proximal=(k + 1, lambda proximal: proximal + np.array([3.0, 1.0])), control=faster)
    before, after = (untrained().predict(episodes, given(brief)) for episodes in (brief, other))
    np.testing.assert_array_equal(before.tip[:, : k + 1], after.tip[:, : k + 1])
    np.testing.assert_array_equal(before.spread[:, : k + 1], after.spread[:, : k + 1])
    assert np.abs(before.tip[:, k + 1] - after.tip[:, k + 1]).max() > 0.1


def test_a_tip_that_is_not_observed_is_not_read_and_one_that_is_counts(brief):
    blind = changed(brief, tip=(GIVEN, np.nan))
    predictor, observed = untrained(), given(brief)
    found = predictor.predict(brief, observed)
    np.testing.assert_array_equal(predictor.predict(blind, observed).tip, found.tip)
    later = observed.copy()
    later[36] = True
    more = predictor.predict(brief, later)
    np.testing.assert_array_equal(more.tip[:, :36], found.tip[:, :36])
    np.testing.assert_array_equal(more.tip[:, 36], brief.tip[:, 36].astype(float))
    assert np.abs(more.tip[:, 37:] - found.tip[:, 37:]).max() > 0.01


def test_what_is_observed_of_one_navigation_changes_no_other_one(brief):
    predictor, observed = untrained(), np.tile(given(brief), (len(brief), 1))
    found = predictor.predict(brief, observed)
    observed[1, 36] = True
    more = predictor.predict(brief, observed)
    np.testing.assert_array_equal(more.tip[2:], found.tip[2:])
    assert np.abs(more.tip[1, 37:] - found.tip[1, 37:]).max() > 0.01


def test_some_navigations_are_predicted_as_they_are_among_all(brief):
    predictor = untrained()
    found, last = predictor.predict(brief, given(brief)), np.array([len(brief) - 1])  # of the second patient
    alone = predictor.predict(brief.select(last), given(brief))
    np.testing.assert_allclose(alone.tip, found.tip[last], atol=1e-5)
    np.testing.assert_allclose(alone.spread, found.spread[last], atol=1e-5)
    assert len(predictor.prepared[brief.setup][0]) == 2  # the tables of both were used again


def test_a_later_x_ray_helps(packaged, everyone):
    early = given(everyone)
    later = early.copy()
    later[[45, 55]] = True
    without, helped = (
        np.abs(packaged.predict(everyone, observed).tip - everyone.tip)[:, 46:70, 0].mean()
        for observed in (early, later)
    )
    assert helped < without


@pytest.mark.parametrize("protocol", ["rollout_inverse", "rollout_dual"])
def test_inverse_reads_no_later_motion_and_no_later_desired_tip(brief, protocol, monkeypatch):
    monkeypatch.setattr("endopilot.models.causal._REFINEMENTS", 1)
    k = 36
    rollout = getattr(untrained(), protocol)
    whole = rollout(brief).control
    np.testing.assert_array_equal(whole, rollout(changed(brief, control=(GIVEN, 7.0), proximal=(GIVEN, 7.0))).control)
    cut = rollout(changed(brief, tip=(k + 1, lambda tip: np.stack([tip[..., 0] - 2.0, 0.1 + 0 * tip[..., 1]], -1))))
    cut = cut.control
    np.testing.assert_array_equal(whole[:, : k + 1 - GIVEN], cut[:, : k + 1 - GIVEN])
    assert np.abs(whole - cut).max() > 0.1


def test_a_plan_under_way_begins_where_the_drive_is_and_uses_what_was_observed(brief, monkeypatch):
    monkeypatch.setattr("endopilot.models.causal._REFINEMENTS", 1)
    now, observed = 37, given(brief)
    observed[now] = True
    predictor = untrained()
    plan = predictor.rollout_dual(brief, observed)
    assert plan.control.shape == (len(brief), brief.samples - now - 1, 2)
    start = brief.proximal[:, now].astype(float)
    np.testing.assert_allclose(plan.proximal[:, 0], start + 0.5 * plan.control[:, 0], atol=1e-9)
    # the drive's later motion is not read, its motion since the given states is
    later = changed(brief, control=(now + 1, 7.0), proximal=(now + 1, 7.0))
    np.testing.assert_array_equal(predictor.rollout_dual(later, observed).control, plan.control)
    moved = later.proximal.copy()
    moved[:, GIVEN : now + 1, 0] += 2.0
    assert np.abs(predictor.rollout_dual(replace(brief, proximal=moved), observed).tip - plan.tip).max() > 0.1
    # nor is the observed tip forgotten: without it, the same navigation goes on otherwise
    blind = given(brief)
    blind[now - 1] = True
    assert np.abs(predictor.rollout_dual(brief, blind).tip[:, 1:] - plan.tip).max() > 1e-3


def test_the_play_operator_alone_beats_holding_the_slack(everyone, dataset):
    patient = np.unique(everyone.anatomy, return_inverse=True)[1]
    observed = np.broadcast_to(given(everyone), everyone.branch.shape)
    guess = unfold("forward", play_tables(everyone), patient, everyone, observed).guess[:, GIVEN:]
    held = error(hold_slack(dataset, GIVEN), everyone)[..., 0]
    assert error(guess, everyone)[..., 0].mean() < 0.5 * held.mean()


def test_mirrored_vessels_behave_alike(brief):
    assert mirrored().shape == (N_FEATURES,)
    vessels = play_tables(brief)
    forms = Sequences.of(brief.select(np.array([0, len(brief) - 1])), vessels, ("ff",), 0)  # one of each patient
    inputs, _, change = forms.window("ff", torch.tensor([[0, 0], [0, 2]]))
    np.testing.assert_array_equal(change[0], change[1])
    assert (inputs[0] != inputs[1]).any()
    # a vessel in the mirror, with the wire turned the other way, gives the mirrored features
    geometry = vessels.geometry * np.array([-1.0, 1, -1, 1, 1, 1, 1])  # in the plane that the unturned tip bends in

    def flipped(tables):
        return tuple(np.roll(table[:, ::-1], 1, axis=1) for table in tables)

    twin = replace(
        vessels,
        geometry=geometry,
        known={direction: flipped(tables) for direction, tables in vessels.known.items()},
        clearance=flipped(vessels.clearance),
        deepest=np.roll(vessels.deepest[:, ::-1], 1, axis=1),
        leaf=np.roll(vessels.leaf[:, ::-1], 1, axis=1),
        on_route=np.roll(vessels.on_route[..., ::-1], 1, axis=2),
    )
    other_way = np.array([1, -1], dtype=brief.proximal.dtype)
    turned = replace(brief, proximal=other_way * brief.proximal, initial=other_way * brief.initial)
    patient = np.unique(brief.anatomy, return_inverse=True)[1]
    observed = np.broadcast_to(given(brief), brief.branch.shape)
    ours = unfold("forward", vessels, patient, brief, observed).inputs * np.append(
        mirrored(), np.ones(N_INPUTS - N_FEATURES)
    )
    theirs = unfold("forward", twin, patient, turned, observed).inputs
    np.testing.assert_allclose(ours, theirs, atol=2e-3)


def test_the_wire_that_retraces_the_given_tips_is_found_and_simulated_once(brief, tmp_path):
    own = brief.setup.device
    smoother = replace(brief, setup=replace(brief.setup, device=replace(own, friction=0.85 * own.friction)))
    brief, smoother = brief.select(np.arange(4)), smoother.select(np.arange(4))  # of one patient
    wires, seen, unseen = SimulatedWires(), every(brief), np.zeros(brief.branch.shape, dtype=bool)
    tips, blind = wires.tips(smoother, seen).tip, wires.tips(smoother, unseen).tip
    fits = np.array(list(wires.fits[smoother.setup].values()))
    assert (fits[len(brief) :] == 1.0).all()  # where nothing was observed, the wire is as it is given
    assert np.abs(np.median(fits[: len(brief), 0]) - 1 / 0.85) < 0.05, fits
    middle, later = FRICTION_FACTORS.index(1.0), slice(GIVEN, None)
    off, blind_off = (np.abs(tip[:, later, middle, 0] - brief.tip[:, later, 0]).mean() for tip in (tips, blind))
    assert off < 0.35 * blind_off, (off, blind_off)
    some = np.array([len(brief) - 1, 0])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("endopilot.models.simulated_wires.ensemble_of", None)
        patch.setattr("endopilot.models.fitted_wires.ensemble_of", None)
        np.testing.assert_array_equal(wires.tips(smoother.select(some), seen[some]).tip, tips[some])
    twice = np.tile(np.arange(len(brief)), 2)
    for half in read_or_simulate(tmp_path, smoother.select(twice), seen[twice]).halves():
        np.testing.assert_array_equal(half.tip, tips)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("endopilot.models.simulated_wires.fitted", lambda few, _: np.ones((len(few), 4)))
        patch.setattr("endopilot.models.simulated_wires._of_one_patient", each_numbered)
        np.testing.assert_array_equal(
            read_or_simulate(tmp_path, smoother.select(twice), seen[twice]).halves()[1].tip, tips
        )
        again = np.array([3, 0, 3])
        other = read_or_simulate(tmp_path, smoother.select(again), seen[again])  # other episodes are other wires
        np.testing.assert_array_equal(other.tip[:, 0, 0, 0], [0, 1, 0])  # those that are the same are simulated once
        unlike = read_or_simulate(None, smoother.select(again), np.stack([seen[3], seen[0], unseen[3]]))
        np.testing.assert_array_equal(unlike.tip[:, 0, 0, 0], [0, 1, 2])


@pytest.mark.parametrize("first", [30, 35])
def test_another_end_of_a_navigation_is_simulated_from_where_it_begins(brief, first):
    some = brief.select(np.array([0, len(brief) - 1]))
    wires = SimulatedWires()
    before = wires.tips(some, every(some)).tip
    later = some.control[:, first:].copy()
    later[..., 0] *= 0.5
    other = some.driven(some.proximal[:, first:], later)
    with pytest.MonkeyPatch.context() as patch:  # none is brought to its start again
        patch.setattr("endopilot.models.simulated_wires.ensemble_of", None)
        patch.setattr("endopilot.models.fitted_wires.ensemble_of", None)
        tips = wires.tips(other, every(some)).tip
    fits = np.array(list(wires.fits[some.setup].values()))
    np.testing.assert_array_equal(tips, simulated_tips(other, fits)[:, :, : len(FRICTION_FACTORS)])
    assert (tips != before).any()


def test_a_wire_whose_simulation_fails_is_where_the_guess_is(brief):
    vessels, patient = play_tables(brief), np.unique(brief.anatomy, return_inverse=True)[1]
    observed = every(brief)
    wires = WIRES.tips(brief, observed)
    whole = unfold("forward", vessels, patient, brief, observed, wires)
    wires.tip[2, 40:, 1] = np.nan
    found = unfold("forward", vessels, patient, brief, observed, wires)
    assert np.isfinite(found.inputs).all() and (found.others[2, 40:, 1] == 0).all()
    np.testing.assert_array_equal(found.inputs[2, :40], whole.inputs[2, :40])
    np.testing.assert_array_equal(np.delete(found.inputs, 2, axis=0), np.delete(whole.inputs, 2, axis=0))


def test_a_jump_of_the_wires_that_are_trusted_is_announced(packaged, brief, monkeypatch):
    observed, at = every(brief), 40
    wires = WIRES.tips(brief, observed)
    jumped = replace(wires, tip=wires.tip.copy())
    jumped.tip[:, at:, :, 0] += 2 * JUMP_MM
    calm = packaged.predict(brief, observed).jump
    monkeypatch.setattr(SimulatedWires, "tips", lambda *_: jumped)
    found = packaged.predict(brief, observed).jump
    assert np.median(calm[:, at]) < 0.1 < np.median(found[:, at])


def test_the_median_of_a_mixture_has_half_of_it_below():
    generator = torch.Generator().manual_seed(0)
    weight = torch.log_softmax(torch.randn(3, 5, 4, generator=generator), dim=-1)
    location = 3 * torch.randn(3, 5, 4, 2, generator=generator)
    scale = 0.1 + torch.rand(3, 5, 4, 2, generator=generator)
    mixture = Mixture(weight, location, scale, torch.zeros(3, 5))
    median = mixture.median()
    away = (median[..., None, :] - location) / scale
    # P(x < m) = ½ exp(−|m − μ|/b) below a component's median, 1 − that above it
    below = torch.where(away < 0, 0.5 * torch.exp(-away.abs()), 1 - 0.5 * torch.exp(-away.abs()))
    np.testing.assert_allclose((weight.exp()[..., None] * below).sum(dim=-2), 0.5, atol=1e-5)
    # variance of a Laplace distribution: 2 b²
    alone = Mixture(torch.zeros(1, 1, 1), torch.ones(1, 1, 1, 2), 0.5 * torch.ones(1, 1, 1, 2), torch.zeros(1, 1))
    np.testing.assert_allclose(alone.deviation(alone.median()), np.sqrt(0.5), rtol=1e-5)


def test_a_jump_is_a_motion_that_the_drive_did_not_make():
    inserted = np.array([[10.0, 12.0, 20.0, 20.0]])
    slack = np.array([[1.0, 1.0 + 0.9 * JUMP_MM, 1.0, 1.0 + 1.1 * JUMP_MM]])
    assert jumps(inserted - slack, inserted).tolist() == [[False, False, False, True]]


def test_the_packaged_forward_network_says_where_a_tip_may_jump(packaged, everyone):
    probability = packaged.predict(everyone, given(everyone)).jump
    jumping = jumps(everyone.tip[..., 0].astype(float), everyone.proximal[..., 0].astype(float))
    assert probability.min() >= 0 and probability.max() <= 1 and jumping.any()
    assert probability[jumping].mean() > 10 * probability[~jumping].mean()


def test_a_seed_repeats_to_the_bit_and_an_interrupted_run_goes_on(folder, tmp_path):
    train(folder, output=tmp_path / "once", config=SHORT)
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
        train(folder, output=tmp_path / "cut", config=SHORT)
    train(folder, output=tmp_path / "cut", config=SHORT)
    assert sha256(tmp_path / "cut/ff.safetensors") == sha256(tmp_path / "once/ff.safetensors")
    assert isinstance(load_model(tmp_path / "cut"), CausalPredictor)


def test_bad_input_is_named(brief, tmp_path):
    with pytest.raises(InputError, match="no inverse network; train it with --network both"):
        replace(untrained(), inverse=None).rollout_dual(brief)
    with pytest.raises(InputError, match=r"^width: 0"):
        CausalConfig(width=0)
    with pytest.raises(InputError, match="no such run; give a folder made by `endopilot train`, or 'pretrained'"):
        load_model(tmp_path / "nothing")


def test_a_wire_that_the_vessel_holds_ends_where_it_is(folder):
    anatomy = read_anatomy(next(folder.parent.glob("rca-*")))
    weak = replace(read_wire("workhorse-014"), pull_limit_n=1e-9)  # friction holds it
    patient = prepare(anatomy, weak, SimulatorConfig(element_mm=1.25, tolerance_mm=1e-2))
    slack = np.arange(patient.pull_tip.shape[1]) * STEP_MM - patient.pull_tip
    assert (patient.deepest > 20.0).all()
    assert (np.ptp(slack[:, :5], axis=1) < 1e-9).any()  # nothing is known of lengths that it is not pulled back to


@pytest.mark.parametrize("noise_mm", [0.0, 0.3])
def test_a_fit_is_as_sure_as_what_it_explains(noise_mm):
    random = np.random.default_rng(0)
    slopes = random.normal(size=(4, 30, 2)) * [0.2, 0.05]  # mm a spread of each parameter

    def tips(theta):
        return 50.0 + np.einsum("...k,ksd->...sd", (theta - 1) / SPREADS, slopes)

    theta = rounded(1 + SPREADS * random.uniform(-1, 1, (16, 4)))
    truth = 1 + SPREADS * np.array([0.8, -0.5, 0.3, -0.9])
    seen = tips(truth) + noise_mm * random.normal(size=(30, 2))
    seen[7, 0] += 1.5  # a snap that the true wire made elsewhere
    given = np.ones(30, dtype=bool)
    mean, sd = posterior(theta, tips(theta), seen, np.tile(SCALES_MM, (30, 1)), given)
    off = np.abs(mean - truth) / SPREADS
    assert (off < (0.05 if noise_mm == 0 else 1.0)).all() and (off < 3.5 * sd / SPREADS + 0.02).all(), (
        off,
        sd / SPREADS,
    )
    nothing = posterior(theta, tips(theta), seen, np.tile(SCALES_MM, (30, 1)), ~given)
    np.testing.assert_array_equal(nothing, [np.ones(4), SPREADS])
