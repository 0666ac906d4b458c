"""X-ray advice on a toy wire: what is followed, which events are missed, and the whole command."""

from __future__ import annotations

import json
import shutil
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from command import output_of
from endopilot.anatomy.io import write_anatomy
from endopilot.belief import monitoring
from endopilot.belief.advise import advise
from endopilot.belief.bands import AdviserConfig, Calibration, Predicted
from endopilot.belief.events import Counted
from endopilot.belief.monitor import BelievedTip, Monitor
from endopilot.belief.monitoring import AdviseConfig, Followed, Patient
from endopilot.belief.network_monitor import NetworkMonitor
from endopilot.dataset.config import DatasetConfig
from endopilot.dataset.generate import generate_dataset
from endopilot.dataset.loader import Dataset, read_dataset
from endopilot.devices.catheter import read_catheter
from endopilot.devices.device import read_wire
from endopilot.errors import InputError
from endopilot.files import read_json, write_json
from endopilot.models.config import WINDOW
from endopilot.models.episodes import OpenLoop
from endopilot.simulation.motion import Motion
from endopilot.simulation.world import World
from endopilot.xray.fluoroscope import TipMeasurement
from endopilot.xray.image_fluoroscope import NotRegistered
from toy_navigation import make_toy_dataset, toy_run

CONFIG = AdviseConfig(adviser=AdviserConfig(wall_ratio=0.7, abscissa_mm=0.8))
SHAPE = {"patients": 4, "sequences": 1, "seconds": 25.0, "seen_test_share": 0.0}
SHARES = (1 / 4, 2 / 4, 1 / 4)
LATER = 50 - WINDOW


class HoldSlack:
    """Predicts that slack and offset stay as they were last given."""

    def rollout_forward(self, episodes) -> OpenLoop:
        length = episodes.proximal[..., 0].astype(float)
        slack = (length - episodes.tip[..., 0])[:, WINDOW - 1 : WINDOW]
        offset = np.broadcast_to(episodes.tip[:, WINDOW - 1 : WINDOW, 1], length[:, WINDOW:].shape)
        tip = np.stack([length[:, WINDOW:] - slack, offset.astype(float)], axis=-1)
        return OpenLoop(tip=tip, control=tip)

    rollout_inverse = rollout_dual = rollout_forward


class Asks(NetworkMonitor):
    """Believes what it was shown last, and asks for X-ray at every so many-th sample."""

    def __init__(self, every: int) -> None:
        self.every, self.steps, self.shown, self.lengths = every, 0, list[int](), list[float]()
        self.predicted = Predicted(np.zeros(2), np.zeros(2), np.zeros(2), 1.5)

    def step(self, encoders, load=(), exposure=None) -> BelievedTip:
        if exposure is not None:
            self.shown.append(self.steps - 1)  # the first step is the start
            self.predicted = Predicted(np.zeros(2), np.array([exposure.abscissa, exposure.offset]), np.ones(2), 1.5)
        self.lengths.append(encoders[0][0])
        self.steps += 1
        where = self.predicted.tip.tolist()
        return BelievedTip(where[0], where[1], (1.0, 1.0), "it is time" if self.steps % self.every == 0 else "", "", 0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Return a folder with a dataset of four toy patients, two of which calibrate, and a run."""
    folder = tmp_path_factory.mktemp("advice")
    make_toy_dataset(folder / "dataset", **SHAPE, anatomy_shares=SHARES)
    record = {"config": {}, "networks": {}, "patients": [], "device": asdict(read_wire("workhorse-014"))}
    write_json(folder / "run" / "manifest.json", record)
    return folder


@pytest.fixture(autouse=True)
def hold_slack(monkeypatch) -> None:
    monkeypatch.setattr("endopilot.models.checkpoint.load_model", lambda run: HoldSlack())


@pytest.fixture
def data(folder) -> Dataset:
    data = read_dataset(folder / "dataset").of_split("calibrate")
    return data[data.anatomy == data.anatomy[0]]


def test_x_ray_is_on_at_first_and_then_as_asked_and_shows_what_the_encoder_does_not(data) -> None:
    patient, asks = Patient(data, CONFIG), Asks(7)
    found = patient.follow(0, asks, asked=True)
    assert asks.shown == [*range(WINDOW), 34, 41, 48] and asks.steps == 51
    assert np.flatnonzero(found.exposed).tolist() == [0, 5, 12, 19]
    ostium = data.inserted_length[0, :, 0] - np.array(asks.lengths[1:])
    assert np.ptp(ostium) < 1e-4 and 0.0 < np.abs(ostium).max() <= 0.3
    error = found.predicted[found.exposed] - found.true[found.exposed]
    assert 0.0 < np.abs(error).max() < 2.0  # what X-ray shows, with its errors
    blind = Asks(7)
    assert patient.follow(0, blind, asked=False).exposed.tolist() == [True] + [False] * LATER


def test_encoders_and_exposures_err_as_the_world_of_the_dataset_says(data) -> None:
    world = World(ostium_mm=0.7, registration_mm=(0.4, 0.0, 0.0))  # along the vessel
    changed = replace(data, manifest=data.manifest | {"world": world.differences()})
    (as_given, there), (before, after) = (Asks(1), Asks(1)), (Patient(data, CONFIG), Patient(changed, CONFIG))
    seen, moved = before.follow(0, as_given, asked=True), after.follow(0, there, asked=True)
    np.testing.assert_allclose(np.array(there.lengths[1:]), np.array(as_given.lengths[1:]) - 0.7, atol=1e-6)
    np.testing.assert_array_equal(moved.true, seen.true)
    assert np.median((moved.predicted - seen.predicted)[:, 0]) == pytest.approx(0.4, abs=0.1)


def test_an_image_in_which_no_wire_is_found_counts_shows_nothing_and_is_taken_again(data, monkeypatch) -> None:
    patient = Patient(data, CONFIG)
    whole = patient.follow(0, Asks(7), asked=True)
    expose = patient._exposed
    monkeypatch.setattr(patient, "_exposed", lambda number, sample: None if sample == 34 else expose(number, sample))
    parts, asks = None, Asks(7)
    parts = patient.follow(0, asks, asked=True)
    assert np.flatnonzero(parts.exposed & ~whole.exposed).tolist() == [6] and parts.exposed[5]
    assert 34 not in asks.shown and 35 in asks.shown


def test_events_are_counted_from_the_truth_and_what_was_believed(data) -> None:
    found = {every: Patient(data, CONFIG).follow(0, Asks(every), asked=True) for every in (1, 1000)}
    often, never = (monitoring.measure([each]) for each in found.values())
    assert often["missed_share"] == 0.0 and often["exposures_per_minute"] == pytest.approx(120.0)
    assert never["exposures_per_minute"] == 0.0 and never["missed_share"] == 1.0 == never["missed_evenly_share"]
    assert never["fewer_frames_than_fluoroscopy"] == 1.0
    assert never["wall_events_per_minute"] == often["wall_events_per_minute"] > 0.0


def test_networks_go_on_from_what_x_ray_showed(data) -> None:
    navigation = Patient(data, CONFIG).navigations[0]
    follower = NetworkMonitor(HoldSlack(), navigation, None, CONFIG.adviser)
    found = Patient(data, CONFIG).follow(0, follower, asked=False)
    advance = np.diff(found.length_mm).cumsum()
    np.testing.assert_allclose(found.predicted[1:, 0], found.predicted[0, 0] + advance, atol=1e-5)
    assert (found.predicted[1:, 1] == found.predicted[0, 1]).all() and not found.spread.any()


class Arm:
    """Measures the foremost node as it is; does not recognise one patient."""

    def __init__(self, navigation, **_) -> None:
        self.known_motion, self.forgot = navigation.known_motion, 0
        if navigation.anatomy.name.endswith("-1x"):
            raise NotRegistered(f"X-ray images: {navigation.anatomy.name} cannot be registered: nothing seen")

    def measure_motion(self, motion, random) -> Motion:
        return replace(motion, breathing_caudal_mm=motion.breathing_caudal_mm - 1.5)

    def forget_wires(self) -> None:
        self.forgot += 1

    def measure(self, nodes, inserted_length, random) -> TipMeasurement:
        return TipMeasurement(nodes[0], float(nodes[0][0]), float(nodes[0][1]), 0)


def test_with_images_the_wire_is_driven_again_and_shown_as_far_as_its_motion_is_not_known(folder, monkeypatch) -> None:
    monkeypatch.setattr(monitoring, "make_c_arm", Arm)
    monkeypatch.setattr("endopilot.dataset.loader.run_set_up", toy_run)
    data, config = read_dataset(folder / "dataset"), replace(CONFIG, xray="images")
    still, left_out = monitoring.follow_all(data, lambda *_: Asks(1), config, BANDS)
    assert left_out == ["patient-1x"] and len(still) == 3
    for each in still:
        np.testing.assert_allclose(each.predicted, each.true, atol=1e-4)
    with pytest.raises(InputError, match=r"no patient of its split .* can be registered; first: X-ray images"):
        monitoring.follow_all(data[data.anatomy == "patient-1x"], lambda *_: Asks(1), config)
    motion = replace(Motion(), breathing_caudal_mm=8.0)
    monkeypatch.setattr(Dataset, "motion", lambda self, name: motion)
    patient = Patient(data[data.anatomy == "patient-0"], config)
    assert patient.navigations[0].known_motion == replace(motion, breathing_caudal_mm=6.5)
    moved = patient.follow(0, Asks(1), asked=True)
    assert 0.01 < np.abs(moved.predicted - moved.true).max() < 0.5


def followed(patient: str, error: np.ndarray, half: float = np.nan, missed: int = 0) -> Followed:
    """Return a navigation of twenty samples in which predictions err, and events are missed, by so much."""
    samples = len(error) + 1
    predicted = np.concatenate([np.zeros((1, 2)), error])
    nothing, events = Counted(0, 0, 0.0), Counted(10, missed, 10.0)
    return Followed(
        patient=patient,
        length_mm=np.linspace(0.0, 10.0, samples),
        true=np.zeros((samples, 2)),
        predicted=predicted,
        spread=np.zeros((samples, 2)),
        half_width=np.full((samples, 2), half),
        exposed=np.arange(samples) % 5 == 0,
        events={"wall": events, "astray": nothing, "force": nothing},
    )


def jumping(patients: int, seed: int) -> list[Followed]:
    """Return six navigations of each patient: Δtip errs by 0.1 mm or by many mm, γtip by 0.01 mm always."""
    random = np.random.default_rng(seed)
    size = [np.array([0.1 * np.exp(2 * random.standard_normal()), 0.01]) for _ in range(6 * patients)]
    return [followed(f"{k % patients}", each * random.standard_normal((20, 2))) for k, each in enumerate(size)]


def test_both_bands_hold_together_though_their_errors_are_spread_otherwise() -> None:
    """Δtip has rare large errors, γtip has not."""
    bands = monitoring.calibrate(jumping(60, 0), jumping(100, 1), 0.9, "key")
    half = [bands.half_width(*each.grown) for each in jumping(300, 2)]
    held = np.array([(each.error <= h).all(axis=0) for each, h in zip(jumping(300, 2), half, strict=True)])
    assert held.all(axis=1).mean() == pytest.approx(0.9, abs=0.03)
    assert (held.mean(axis=0) > 0.9).all() and (held.mean(axis=0) < 0.995).all()  # neither is wider than needed
    assert bands.longest_s == 10.0 and bands.anatomies == 100 and bands.intervals == 600


def test_bands_hold_where_they_do_throughout_an_interval_without_x_ray() -> None:
    error = np.zeros((20, 2))
    error[7, 0] = 2.0  # in the second of four intervals; the fifth sample of each has X-ray
    error[4] = 9.0
    found = monitoring.coverage([followed("a", error, half=1.0), followed("b", 0 * error, half=np.inf)])
    assert found["intervals"] == 8 and found["patients"] == 2
    assert found["each_band"] == [3 / 8, 4 / 8] and found["simultaneous"] == 3 / 8  # infinite ones hold nothing
    assert found["samplewise"] == 15 / 32 and found["worst_decile_of_patients"] == 0.0


BANDS = Calibration(
    level=0.9, scale=1.0, abscissa_terms=(0.0,) * 4, offset_terms=(0.0,) * 4, anatomies=3, intervals=30, dataset="",
    onset=0.3, longest_s=45.0,
)  # fmt: skip


@pytest.mark.parametrize(("missed", "onset"), [([0, 0, 0, 0, 0], 0.5), ([0, 1, 5, 0, 0], 0.1), ([9] * 5, 0.05)])
def test_contacts_may_be_as_likely_as_what_may_be_missed_allows(missed, onset) -> None:
    """None beyond the first that misses too much is chosen; patients are alike, so that no error is added."""
    of = dict(zip(monitoring.ONSETS, missed, strict=True))
    tried = list[float]()

    def measured(bands: Calibration) -> list[Followed]:
        tried.append(bands.onset)
        return [followed(name, np.zeros((20, 2)), missed=of[bands.onset]) for name in "abc"]

    greatest, curve = monitoring.greatest_onset(measured, BANDS, 0.25)
    assert greatest == onset and [each["onset"] for each in curve] == tried
    assert tried == list(monitoring.ONSETS)[: len(tried)]


def test_the_command_calibrates_measures_and_draws(folder, tmp_path, capsys) -> None:
    make_toy_dataset(tmp_path / "other", **SHAPE, anatomy_shares=SHARES, friction=(0.3, 0.3))
    make_toy_dataset(tmp_path / "all", **SHAPE, anatomy_shares=(0.0, 0.0, 1.0))
    run, dataset, output = folder / "run", folder / "dataset", folder / "out"
    others = [str(dataset), str(tmp_path / "other")]
    printed = output_of(capsys, "advise", run, dataset, "-o", output, "--level", "0.5", "--also-test", *others)
    assert "missed_share" in printed and "exposures_per_minute" in printed
    figures = json.loads((output / "advice.json").read_text(encoding="utf-8"))
    assert Calibration.read(run).scale == figures["calibration"]["scale"] > 0
    assert figures["calibration"]["anatomies"] == 2 and figures["coverage"]["patients"] == 1
    assert 0 <= figures["coverage"]["simultaneous"] <= 1 and 0 <= figures["coverage"]["samplewise"] <= 1
    assert (output / "advice.png").stat().st_size > 10_000
    assert figures["adviser"]["onset"] == figures["calibration"]["onset"]
    same, other = figures["made_otherwise"]
    assert same["differs"] == {} and other["differs"] == {"friction": [0.3, 0.3]}
    assert same["coverage"] == figures["coverage"] and same["adviser"].items() <= figures["adviser"].items()
    with pytest.raises(InputError, match="which the bands are fitted to"):
        advise(
            run, dataset, tmp_path / "no", AdviseConfig(adviser=AdviserConfig(level=0.5)), also_test=[tmp_path / "all"]
        )
    assert not (tmp_path / "no").exists()


def test_too_few_patients_another_wire_or_no_run_leave_nothing_behind(folder, tmp_path) -> None:
    out = tmp_path / "out"
    with pytest.raises(InputError, match="needs at least 9 patients"):
        advise(folder / "run", folder / "dataset", out, AdviseConfig())
    with pytest.raises(InputError, match="no-run: no such run; give a folder made by"):
        advise(tmp_path / "no-run", folder / "dataset", out, AdviseConfig())
    record = {"config": {}, "networks": {}, "patients": [], "device": asdict(read_wire("j-035"))}
    write_json(tmp_path / "manifest.json", record)
    with pytest.raises(InputError, match=r"its wire is workhorse-014, and that of .* is j-035"):
        advise(tmp_path, folder / "dataset", out, AdviseConfig())
    shutil.copytree(folder, tmp_path / "pairs")
    manifest = tmp_path / "pairs/dataset/meta/manifest.json"
    write_json(manifest, read_json(manifest) | {"catheters": [asdict(read_catheter("microcatheter-1.7f"))]})
    with pytest.raises(InputError, match=r"its wire lies in microcatheter-1\.7f; make it without --catheter for wires"):
        advise(Path("wires"), tmp_path / "pairs/dataset", out, AdviseConfig())
    assert not out.exists() and not (tmp_path / "xray.json").exists()


def test_simulated_wires_are_followed_by_the_belief_of_the_agent(fork, tmp_path) -> None:
    """A deeper ostium is identified from the first 15 s, and the tip then known without X-ray."""
    wire = read_wire("workhorse-014")
    config = DatasetConfig(sequences=1, seconds=18.0, seed=3, seen_test_share=0.0)
    write_anatomy(fork, output=tmp_path / "fork")
    generate_dataset([tmp_path / "fork"], output=tmp_path / "d", device=wire, config=config, world=World(ostium_mm=2.5))
    (followed_by,) = Patient(read_dataset(tmp_path / "d"), AdviseConfig()).navigations
    monitor = Monitor(
        followed_by, replace(BANDS, scale=0.2, abscissa_terms=(1.0, 0, 0, 0), offset_terms=(1.0, 0, 0, 0))
    )
    found = Patient(read_dataset(tmp_path / "d"), AdviseConfig()).follow(0, monitor, asked=False)
    assert monitor.identified is not None and monitor.belief.mean_ostium_mm == pytest.approx(2.5, abs=0.7)
    assert found.error[:, 0].mean() < 1.0
