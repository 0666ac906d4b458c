"""X-ray advice on a toy wire: what counts as an event, which are missed, and the whole command."""

from __future__ import annotations

import json
from dataclasses import asdict, astuple, replace
from pathlib import Path

import numpy as np
import pytest

from endopilot.belief import advise as advise_module
from endopilot.belief import monitoring
from endopilot.belief.advise import advise
from endopilot.belief.adviser import AdviserConfig
from endopilot.belief.bands import Calibration
from endopilot.belief.image_exposures import Exposures
from endopilot.belief.monitoring import AdviseConfig
from endopilot.belief.online_predictors import OnlinePredictor, OnlineWindowed, OnlineWires, online_predictor
from endopilot.cli import main
from endopilot.dataset.loader import read_dataset
from endopilot.devices.device import read_wire
from endopilot.errors import InputError
from endopilot.files import write_json
from endopilot.models.config import WINDOW
from endopilot.models.episodes import OpenLoop
from endopilot.models.simulated_wires import SimulatedWires
from endopilot.simulation.motion import Motion
from endopilot.simulation.world import World
from toy_navigation import make_toy_dataset

EVENTS = AdviserConfig(wall_ratio=0.7, abscissa_mm=0.8)


class HoldSlack:
    """Predicts that slack and offset stay as they were last given."""

    def rollout_forward(self, episodes) -> OpenLoop:
        length = episodes.proximal[..., 0].astype(float)
        slack = (length - episodes.tip[..., 0])[:, WINDOW - 1 : WINDOW]
        offset = np.broadcast_to(episodes.tip[:, WINDOW - 1 : WINDOW, 1], length[:, WINDOW:].shape)
        tip = np.stack([length[:, WINDOW:] - slack, offset.astype(float)], axis=-1)
        return OpenLoop(tip=tip, proximal=tip, control=tip)

    rollout_inverse = rollout_forward

    def rollout_dual(self, episodes, observed=None) -> OpenLoop:
        return self.rollout_forward(episodes)


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Return a folder with a dataset of twelve toy patients, ten of which calibrate, and a run."""
    folder = tmp_path_factory.mktemp("advice")
    shares = (1 / 12, 10 / 12, 1 / 12)
    shape = {"patients": 12, "sequences": 1, "seconds": 25.0}
    make_toy_dataset(folder / "dataset", **shape, anatomy_shares=shares, seen_test_share=0.0)
    record = {"config": {}, "networks": {}, "device": asdict(read_wire("workhorse-014"))}
    write_json(folder / "run" / "manifest.json", record)
    return folder


@pytest.fixture
def hold_slack(monkeypatch) -> None:
    monkeypatch.setattr("endopilot.models.checkpoint.load_model", lambda run: HoldSlack())


@pytest.fixture(scope="module")
def split(folder) -> monitoring.Monitored:
    return monitoring.monitor(HoldSlack(), read_dataset(folder / "dataset").of_split("calibrate"), AdviseConfig())


def test_tips_are_given_as_x_ray_measures_them_and_lengths_as_the_encoder_does(split, folder) -> None:
    error = split.episodes.tip[..., 0] - split.truth[..., 0]
    assert 0.1 < error.std() < 0.8
    truth = read_dataset(folder / "dataset").of_split("calibrate")
    ostium = truth.inserted_length[..., 0] - split.episodes.proximal[..., 0]
    assert np.ptp(ostium, axis=1).max() < 1e-4 and 0.1 < np.abs(ostium).max() <= 0.3
    np.testing.assert_allclose(truth.initial[:, 0, 0] - split.episodes.initial[:, 0], ostium[:, 0], atol=1e-4)
    np.testing.assert_array_equal(split.episodes.proximal[..., 1], truth.rotation[..., 0])


def test_encoders_and_exposures_err_as_the_world_of_the_dataset_says(split, folder) -> None:
    data = read_dataset(folder / "dataset").of_split("calibrate")
    world = World(ostium_mm=0.7, registration_mm=(0.4, 0.0, 0.0))  # along the vessel
    changed = replace(data, manifest=data.manifest | {"world": world.differences()})
    found = monitoring.monitor(HoldSlack(), changed, AdviseConfig())
    np.testing.assert_allclose(found.proximal[..., 0], split.proximal[..., 0] - 0.7, atol=1e-6)
    assert (found.truth == split.truth).all()
    along = (found.episodes.tip - split.episodes.tip)[..., 0]
    assert np.median(along) == pytest.approx(0.4, abs=0.1)


def test_imaging_often_enough_shows_every_event_and_none_shows_no_event(split) -> None:
    often = monitoring.measure_policy(split, monitoring.periodic_policy(split, 2), EVENTS)
    never = monitoring.measure_policy(split, lambda sample, tip, spread: np.zeros(len(tip), dtype=bool), EVENTS)
    knowing = monitoring.measure_policy(split, monitoring.oracle_policy(split, EVENTS), EVENTS)
    assert often["missed_share"] == 0.0 and often["exposures_per_minute"] == pytest.approx(60.0, rel=0.02)
    assert monitoring.measure_metronome(split, often["exposures_per_minute"], EVENTS) == often
    assert never["missed_share"] == 1.0  # X-ray was on until the first sample, before all of them
    assert never["exposures_per_minute"] == 0.0
    assert never["events_per_minute"] > 1.0 and never["fewer_frames_than_fluoroscopy"] == 1.0
    assert knowing["missed_share"] == 0.0
    assert knowing["exposures_per_minute"] <= knowing["events_per_minute"]  # one exposure may show two events


def test_an_observation_changes_later_predictions_and_nothing_before(split) -> None:
    model = OnlineWindowed(HoldSlack(), split.episodes)
    before = model.tip.copy()
    model.observe(np.array([1]), 34, np.array([[20.0, 0.4]]), np.array([0]))
    np.testing.assert_array_equal(model.tip[:, :35], before[:, :35])
    np.testing.assert_array_equal(model.tip[[0, 2]], before[[0, 2]])
    length = split.episodes.proximal[1, :, 0]
    np.testing.assert_allclose(model.tip[1, 35:, 0], length[35:] - (length[34] - 20.0), rtol=1e-5)
    np.testing.assert_allclose(model.tip[1, 35:, 1], 0.4, rtol=1e-5)
    model.reset()
    np.testing.assert_array_equal(model.tip, before)


def test_an_image_in_which_no_wire_is_found_shows_nothing_and_is_taken_again(split) -> None:
    policy = monitoring.periodic_policy(split, 4)
    whole = monitoring.follow_policy(split, policy, EVENTS)
    at = int(np.flatnonzero(whole.exposed[0])[1])  # from the last given sample on
    found = split.found.copy()
    found[0, WINDOW - 1 + at] = False
    unseen = replace(split, found=found)
    parts = monitoring.follow_policy(unseen, monitoring.periodic_policy(unseen, 4), EVENTS)
    assert np.flatnonzero(parts.exposed[0] & ~whole.exposed[0]).tolist() == [at + 1]
    assert parts.exposed[0, at]  # it counts all the same
    assert whole.shown[0, at] and not parts.shown[0, at] and parts.shown[0, at + 1]
    np.testing.assert_array_equal(parts.exposed[1:], whole.exposed[1:])


def test_models_know_the_motion_that_images_have_measured(folder, split, monkeypatch) -> None:
    truth = read_dataset(folder / "dataset").of_split("calibrate")
    moves = replace(Motion(), breathing_caudal_mm=7.0)

    def images(dataset, settings) -> tuple[dict[str, Exposures], tuple[str, ...]]:
        shown = {}
        for name in sorted(set(dataset.anatomy.tolist())):
            mine = split.episodes.select(np.flatnonzero(dataset.anatomy == name))
            sd_mm, found = np.zeros(mine.tip.shape), np.ones(mine.branch.shape, dtype=bool)
            motion = np.array(astuple(moves) if len(name) % 2 == 0 else ())
            shown[name] = Exposures(mine.tip, mine.branch, sd_mm, found, motion)
        return shown, ()

    monkeypatch.setattr(monitoring, "image_exposures", images)
    found = monitoring.monitor(HoldSlack(), truth, AdviseConfig(xray="images"))
    known = {name: moves for name in set(truth.anatomy.tolist()) if len(name) % 2 == 0}
    assert known and found.episodes.setup.known_motions == known
    np.testing.assert_array_equal(found.episodes.tip, split.episodes.tip)


class Errs(OnlinePredictor):
    """Errs by given amounts and states no spread."""

    def __init__(self, tip: np.ndarray) -> None:
        self.tip, self.spread = tip, np.zeros_like(tip)

    def reset(self) -> None:
        pass

    def observe(self, episodes, sample, tip, branch, sd_mm) -> None:
        pass


class Straight(monitoring.Lumen):
    """A lumen of one radius."""

    def __init__(self, radius_mm: float) -> None:
        self._radius_mm = radius_mm

    def radius(self, branch, abscissa_mm) -> np.ndarray:
        return np.full(len(branch), self._radius_mm)


def jumping(split, patients: int, seed: int) -> monitoring.Monitored:
    """Return six navigations of each patient: Δtip errs by 0.1 mm or by many mm, γtip by 0.01 mm always."""
    random, count = np.random.default_rng(seed), 6 * patients
    chosen = np.arange(count) % len(split.truth)
    truth = split.truth[chosen]
    size = np.stack([0.1 * np.exp(2 * random.standard_normal(count)), np.full(count, 0.01)], axis=-1)
    names = np.repeat([f"patient-{seed}-{k}" for k in range(patients)], 6)
    return replace(
        split,
        truth=truth,
        ratio=split.ratio[chosen],
        episodes=replace(split.episodes.select(chosen), anatomy=names),
        found=split.found[chosen],
        model=Errs(truth + size[:, None] * random.standard_normal(truth.shape)),
        lumen=Straight(1.0),
    )


def test_both_bands_hold_together_though_their_errors_are_spread_otherwise(split) -> None:
    """Δtip has rare large errors, γtip has not."""
    calibration = monitoring.calibrate(jumping(split, 60, 0), jumping(split, 100, 1), AdviserConfig())
    found = monitoring.coverage(jumping(split, 300, 2), calibration)
    assert found["simultaneous"] == pytest.approx(0.9, abs=0.03)
    assert all(0.9 < share < 0.995 for share in found["each_band"])  # neither is wider than the other has need of


def approaching(split, half: float) -> monitoring.Monitored:
    """Return ten navigations of each of three patients, in which the tip comes to the wall at one of the samples.

    The model puts it further from there than it is, by 5 % of a half-width in the first navigation, 15 % in the next.
    """
    count, samples = 30, split.truth.shape[1]
    place = np.arange(count) % 10
    arrived = np.arange(samples) >= (WINDOW + 3 + place)[:, None]
    at_wall = EVENTS.wall_ratio * (1.0 - split.wire_radius_mm)
    truth = np.stack([np.full((count, samples), 20.0), np.where(arrived, at_wall + 1e-6, 0.0)], axis=-1)
    predicted = truth - np.stack([0 * arrived, arrived * half * (place[:, None] + 0.5) / 10], axis=-1)
    chosen = np.zeros(count, dtype=int)
    return replace(
        split,
        truth=truth,
        ratio=np.where(arrived, 1.0, 0.0),
        episodes=replace(split.episodes.select(chosen), anatomy=np.repeat(["a", "b", "c"], 10)),
        found=split.found[chosen],
        model=Errs(predicted),
        lumen=Straight(1.0),
    )


@pytest.mark.parametrize(("may_miss", "offset_share"), [(0.45, 0.6), (0.25, 0.8), (0.001, 1.0)])
def test_the_adviser_uses_as_little_of_the_band_as_what_it_may_miss_allows(split, may_miss, offset_share) -> None:
    """With a share s of the band it sees 10 s of 10 arrivals; the patients are alike, so that no error is added."""
    bands = Calibration(
        level=0.9, scale=1.0, abscissa_terms=(0.0,) * 4, offset_terms=(0.1, 0.0, 0.0, 0.0), anatomies=3, intervals=30,
        dataset="", offset_share=1.0, longest_s=45.0,
    )  # fmt: skip
    config = replace(EVENTS, missed=may_miss)
    assert monitoring.least_offset_share(approaching(split, half=0.1), bands, config) == offset_share


def test_no_share_of_the_band_beyond_the_first_that_misses_too_much_is_chosen(split, monkeypatch) -> None:
    missed = iter([0.01, 0.02, 0.06, *[0.01] * len(monitoring.OFFSET_SHARES)])
    monkeypatch.setattr(monitoring, "surely_missed", lambda *_: next(missed))
    bands = Calibration(
        level=0.9, scale=1.0, abscissa_terms=(0.0,) * 4, offset_terms=(0.0,) * 4, anatomies=3, intervals=30, dataset="",
        offset_share=1.0, longest_s=45.0,
    )  # fmt: skip
    assert monitoring.least_offset_share(approaching(split, half=0.1), bands, EVENTS) == monitoring.OFFSET_SHARES[1]


def test_the_adviser_asks_for_more_where_exposures_show_that_the_model_errs(split) -> None:
    """Bands of ±0.3 mm that never grow ask for X-ray after `longest_s` alone, and the tip drifts by 0.6 mm/s."""
    bands = Calibration(
        level=0.9, scale=1.0, abscissa_terms=(0.3, 0, 0, 0), offset_terms=(0.3, 0, 0, 0), anatomies=3, intervals=30,
        dataset="", offset_share=0.0, longest_s=3.0,
    )  # fmt: skip
    never_at_the_wall = replace(EVENTS, wall_ratio=50.0, abscissa_mm=9.0)
    asked = []
    for drift_mm in (0.0, 0.3):
        tip = np.stack([split.episodes.proximal[..., 0], np.full(split.found.shape, 0.4)], axis=-1)
        tip[:, WINDOW:, 0] -= drift_mm * np.arange(1, tip.shape[1] - WINDOW + 1)
        episodes = replace(split.episodes, tip=tip, tip_sd=np.full(tip.shape, 0.05))
        drifting = replace(split, episodes=episodes, model=online_predictor(HoldSlack(), episodes))
        policy = monitoring.adviser_policy(drifting, bands, never_at_the_wall)
        asked.append(monitoring.follow_policy(drifting, policy, never_at_the_wall).exposed.sum(axis=1))
    assert (asked[0] == 3).all() and (asked[1] > 3).all()  # in 10 s


def test_simulated_wires_are_weighted_by_what_is_observed(split) -> None:
    samples, count = split.truth.shape[1], len(split.truth)
    slack = np.array([0.0, 1.0, 2.0])[:, None, None] * (np.arange(samples) >= WINDOW)
    paths = np.stack([np.broadcast_to(20.0 - slack, (3, count, samples)), np.full((3, count, samples), 0.5)], axis=-1)
    given = replace(split.episodes, tip=np.tile([20.0, 0.5], (count, samples, 1)))

    class Parting(SimulatedWires):
        def paths(self, episodes, seen):
            return paths

    model = OnlineWires(Parting(), given, split.found)
    assert (model.tip[:, WINDOW:, 0] == 19.0).all()  # all alike so far: the middle one
    assert model.spread[0, -1, 0] == pytest.approx(np.sqrt(2 / 3))
    model.observe(np.array([0]), 33, np.array([[18.0, 0.5]]), np.array([0]))
    assert (model.tip[0, 34:, 0] == 18.0).all() and (model.tip[0, WINDOW:34, 0] == 19.0).all()
    assert (model.tip[1:, WINDOW:, 0] == 19.0).all()
    assert model.spread[0, -1, 0] < 0.2
    model.reset()
    unsure = np.array([[50.0, 50.0]])  # the detector's own standard deviations
    model.observe(np.array([0]), 33, np.array([[18.0, 0.5]]), np.array([0]), unsure)
    assert (model.tip[0, 34:, 0] == 19.0).all() and model.spread[0, -1, 0] == pytest.approx(np.sqrt(2 / 3), rel=1e-2)


def test_the_command_calibrates_measures_and_draws(folder, hold_slack, capsys) -> None:
    run, dataset, output = folder / "run", folder / "dataset", folder / "out"
    with pytest.raises(SystemExit) as leave:
        main(["advise", str(run), str(dataset), "-o", str(output), "--abscissa-mm", "0.8"])
    assert leave.value.code == 0
    printed = capsys.readouterr().out
    assert "missed_share" in printed and "exposures_per_minute" in printed
    figures = json.loads((output / "advice.json").read_text(encoding="utf-8"))
    assert Calibration.read(run).scale == figures["calibration"]["scale"] > 0
    assert figures["calibration"]["anatomies"] == 10 and figures["coverage"]["patients"] == 1
    assert 0 <= figures["coverage"]["simultaneous"] <= figures["coverage"]["samplewise"] <= 1
    assert (output / "advice.png").stat().st_size > 10_000
    widest = figures["curves"]["adviser"][-1]
    assert widest["offset_share"] == 2.5 and figures["curves"]["adviser"][0]["offset_share"] == 0.0
    offset_share = figures["calibration"]["offset_share"]
    assert figures["adviser"]["offset_share"] == offset_share == Calibration.read(run).offset_share


def test_the_calibration_of_simulated_wires_goes_to_the_output(
    folder, split, hold_slack, tmp_path, monkeypatch
) -> None:
    monkeypatch.setattr(monitoring, "monitor", lambda *_, **__: split)
    monkeypatch.setattr(advise_module, "PERIODS", (1, 90))
    monkeypatch.setattr(advise_module, "SHARES", ())
    found = advise(Path("wires"), folder / "dataset", tmp_path / "out", AdviseConfig())
    assert Calibration.read(tmp_path / "out") == found["calibration"]
    assert not Path("wires").exists()
    with pytest.raises(InputError, match="no-run: no such run; give a folder made by"):
        advise(tmp_path / "no-run", folder / "dataset", tmp_path / "out", AdviseConfig())


def test_too_few_patients_or_another_wire_leave_nothing_behind(folder, hold_slack, tmp_path) -> None:
    config = AdviseConfig(adviser=AdviserConfig(level=0.95))
    with pytest.raises(InputError, match="needs at least 19 patients"):
        advise(folder / "run", folder / "dataset", tmp_path / "out", config)
    record = {"config": {}, "networks": {}, "device": asdict(read_wire("j-035"))}
    write_json(tmp_path / "manifest.json", record)
    with pytest.raises(InputError, match=r"its wire is workhorse-014, and that of .* is j-035"):
        advise(tmp_path, folder / "dataset", tmp_path / "out", AdviseConfig())
    assert not (tmp_path / "out").exists() and not (tmp_path / "xray.json").exists()


def test_the_same_calibration_is_measured_on_navigations_made_otherwise(
    folder, split, hold_slack, tmp_path, monkeypatch
) -> None:
    shape = {"patients": 12, "sequences": 1, "seconds": 25.0, "seen_test_share": 0.0}
    shares = (1 / 12, 10 / 12, 1 / 12)
    make_toy_dataset(tmp_path / "other", **shape, anatomy_shares=shares, friction=(0.3, 0.3))
    make_toy_dataset(tmp_path / "all", **shape, anatomy_shares=(0.0, 0.0, 1.0))
    monkeypatch.setattr(advise_module, "PERIODS", (1, 90))
    monkeypatch.setattr(advise_module, "SHARES", ())
    run, dataset, output = folder / "run", folder / "dataset", tmp_path / "out"
    found = advise(run, dataset, output, AdviseConfig(), also_test=[dataset, tmp_path / "other"])
    same, other = found["made_otherwise"]
    assert same["differs"] == {} and other["differs"] == {"friction": [0.3, 0.3]}
    assert same["coverage"] == found["coverage"] and same["adviser"] == {
        name: value for name, value in found["adviser"].items() if name != "offset_share"
    }
    assert other["coverage"]["patients"] == 1
    dose, even = (other[name]["exposures_per_minute"] for name in ("adviser", "metronome"))
    assert even == pytest.approx(dose, rel=0.3)
    with pytest.raises(InputError, match="which the bands are fitted to"):
        advise(run, dataset, tmp_path / "no", AdviseConfig(), also_test=[tmp_path / "all"])
    assert not (tmp_path / "no").exists()
