"""X-ray advice on a toy wire: what counts as an event, what as missed, and the whole command."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from endopilot.cli import main
from endopilot.dataset.loader import load_dataset
from endopilot.errors import InputError
from endopilot.files import write_json
from endopilot.models.config import WINDOW, TwinConfig, run_path
from endopilot.models.open_loop import OpenLoop, Prediction
from endopilot.models.twin import TwinPredictor
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.device import read_device
from endopilot.xray import advise as advise_module
from endopilot.xray import monitoring as advice
from endopilot.xray.advise import advise
from endopilot.xray.adviser import AdviserConfig
from endopilot.xray.bands import Calibration
from endopilot.xray.monitoring import AdviseConfig
from endopilot.xray.online_predictors import OnlineTwin, OnlineWindowed, online_predictor
from toy_navigation import make_toy_dataset

EVENTS = AdviserConfig(wall_ratio=0.7, abscissa_mm=0.8)


class HoldSlack:
    """Foretells that slack and offset stay as they were last given."""

    def rollout_forward(self, episodes) -> OpenLoop:
        length = episodes.inserted_length.astype(float)
        slack = (length - episodes.tip_abscissa)[:, WINDOW - 1 : WINDOW]
        offset = np.broadcast_to(episodes.tip_offset[:, WINDOW - 1 : WINDOW], length[:, WINDOW:].shape)
        tip = np.stack([length[:, WINDOW:] - slack, offset.astype(float)], axis=-1)
        return OpenLoop(tip=tip, proximal=tip, control=tip)

    rollout_inverse = rollout_forward

    def rollout_dual(self, episodes, seen=None) -> OpenLoop:
        return self.rollout_forward(episodes)


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Return a folder with a dataset of twelve toy patients, ten of which calibrate, and a run."""
    folder = tmp_path_factory.mktemp("advice")
    shares = (1 / 12, 10 / 12, 1 / 12)
    shape = {"patients": 12, "sequences": 1, "seconds": 25.0}
    make_toy_dataset(folder / "dataset", **shape, anatomy_shares=shares, seen_test_share=0.0)
    record = {"config": {}, "networks": {}, "device": asdict(read_device("workhorse-014"))}
    write_json(folder / "run" / "manifest.json", record)
    return folder


@pytest.fixture
def hold_slack(monkeypatch) -> None:
    monkeypatch.setattr("endopilot.models.rollout.load_model", lambda run: HoldSlack())


@pytest.fixture(scope="module")
def watched(folder) -> advice.Monitored:
    return advice.watch(HoldSlack(), load_dataset(folder / "dataset").of_split("calibrate"), AdviseConfig())


def test_what_is_told_is_measured(watched) -> None:
    off = watched.told.tip_abscissa - watched.truth[..., 0]
    assert 0.1 < off.std() < 0.8
    deeper = watched.told.inserted_length - np.round(watched.told.initial_inserted_length[:, None], 9)
    assert np.isfinite(deeper).all()
    truth = load_dataset(watched.told.folder).of_split("calibrate")
    ostium = truth.inserted_length - watched.told.inserted_length
    assert np.ptp(ostium, axis=1).max() < 1e-4 and 0.1 < np.abs(ostium).max() <= 0.3


def test_imaging_often_enough_misses_nothing_and_none_misses_all(watched) -> None:
    often = advice.run(watched, advice.periodic(watched, 3), EVENTS)
    never = advice.run(watched, lambda sample, tip, spread: np.zeros(len(tip), dtype=bool), EVENTS)
    knowing = advice.run(watched, advice.oracle(watched, EVENTS), EVENTS)
    assert often["missed_share"] == 0.0 and often["exposures_per_minute"] == pytest.approx(40.0, rel=0.02)
    assert 0.7 < never["missed_share"] < 1.0  # what begins at the first sample was seen by the X-ray before
    assert never["exposures_per_minute"] == 0.0
    assert never["events_per_minute"] > 1.0 and never["fewer_frames_than_fluoroscopy"] == 1.0
    assert knowing["missed_share"] == 0.0
    assert knowing["exposures_per_minute"] <= knowing["events_per_minute"]  # one exposure may show two events


def test_what_is_shown_changes_what_is_foretold_later_and_nothing_before(watched) -> None:
    model = OnlineWindowed(HoldSlack(), watched.told)
    before = model.tip.copy()
    model.show(np.array([1]), 34, np.array([[20.0, 0.4]]))
    np.testing.assert_array_equal(model.tip[:, :35], before[:, :35])
    np.testing.assert_array_equal(model.tip[[0, 2]], before[[0, 2]])
    length = watched.told.inserted_length[1]
    np.testing.assert_allclose(model.tip[1, 35:, 0], length[35:] - (length[34] - 20.0), rtol=1e-5)
    np.testing.assert_allclose(model.tip[1, 35:, 1], 0.4, rtol=1e-5)
    model.restart()
    np.testing.assert_array_equal(model.tip, before)


class Doubtful(HoldSlack):
    """Holds the slack of the last tip that was seen, and doubts it by 0.1 mm for each sample since."""

    def foretell(self, episodes, seen) -> Prediction:
        each = np.broadcast_to(seen, episodes.valid.shape)
        here = np.arange(each.shape[1])
        last = np.maximum.accumulate(np.where(each, here, 0), axis=1)
        row = np.arange(len(episodes))[:, None]
        abscissa = episodes.inserted_length - (episodes.inserted_length - episodes.tip_abscissa)[row, last]
        tip = np.stack([abscissa, episodes.tip_offset[row, last]], axis=-1).astype(float)
        return Prediction(tip, np.repeat(0.1 * (here - last)[..., None], 2, axis=-1))


def test_a_model_that_says_how_sure_it_is_is_asked_so(watched) -> None:
    model = online_predictor(Doubtful(), watched.told)
    before = model.tip.copy(), model.spread.copy()
    np.testing.assert_allclose(model.spread[:, WINDOW:, 0], np.tile(0.1 * np.arange(1, 21), (len(before[0]), 1)))
    model.show(np.array([1]), 34, np.array([[20.0, 0.4]]))
    np.testing.assert_array_equal(model.tip[:, :35], before[0][:, :35])
    np.testing.assert_array_equal(model.tip[[0, 2]], before[0][[0, 2]])
    length = watched.told.inserted_length[1]
    np.testing.assert_allclose(model.tip[1, 35:, 0], length[35:] - (length[34] - 20.0), rtol=1e-5)
    np.testing.assert_allclose(model.spread[1, 35:, 1], 0.1 * np.arange(1, 16))
    model.show(np.array([0, 1]), 45, np.array([[30.0, 0.4], [31.0, 0.5]]))
    assert (model.spread[:2, 46] == 0.1).all() and model.spread[2, 46, 0] > 1.5
    model.restart()
    np.testing.assert_array_equal(model.tip, before[0])
    np.testing.assert_array_equal(model.spread, before[1])


def test_a_twin_weighs_its_wires_by_what_is_shown(watched, monkeypatch) -> None:
    samples, count = watched.truth.shape[1], len(watched.truth)
    slack = np.array([0.0, 1.0, 2.0])[:, None, None] * (np.arange(samples) >= WINDOW)
    paths = np.stack([np.broadcast_to(20.0 - slack, (3, count, samples)), np.full((3, count, samples), 0.5)], axis=-1)
    given = replace(
        watched.told, tip_abscissa=np.full((count, samples), 20.0), tip_offset=np.full((count, samples), 0.5)
    )
    monkeypatch.setattr(TwinPredictor, "ensemble", lambda self, episodes, seen: paths)
    config = TwinConfig(members=3, abscissa_sd_mm=0.05)
    model = OnlineTwin(
        TwinPredictor(device=read_device("workhorse-014"), simulator=SimulatorConfig(), config=config), given
    )
    assert (model.tip[:, WINDOW:, 0] == 19.0).all()  # all alike so far: the middle one
    assert model.spread[0, -1, 0] == pytest.approx(np.sqrt(2 / 3))
    model.show(np.array([0]), 33, np.array([[18.0, 0.5]]))
    assert (model.tip[0, 34:, 0] == 18.0).all() and (model.tip[0, WINDOW:34, 0] == 19.0).all()
    assert (model.tip[1:, WINDOW:, 0] == 19.0).all()
    assert model.spread[0, -1, 0] < 0.2


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
    assert widest["width"] == 2.5 and figures["curves"]["adviser"][0]["width"] == 0.0


def test_the_calibration_of_the_model_of_the_package_goes_to_the_output(
    folder, watched, hold_slack, tmp_path, monkeypatch
) -> None:
    monkeypatch.setattr(advice, "watch", lambda *_: watched)
    monkeypatch.setattr(advise_module, "PERIODS", (1, 90))
    monkeypatch.setattr(advise_module, "WIDTHS", (1.0,))
    monkeypatch.setattr(advise_module, "THRESHOLDS", ())
    packaged = Calibration.read(run_path(Path("pretrained")))
    found = advise(Path("pretrained"), folder / "dataset", tmp_path / "out", AdviseConfig())
    assert Calibration.read(tmp_path / "out") == found["calibration"]
    assert Calibration.read(run_path(Path("pretrained"))) == packaged != found["calibration"]
    assert not Path("pretrained").exists()
    with pytest.raises(InputError, match="no-run: no such run; give a folder made by"):
        advise(tmp_path / "no-run", folder / "dataset", tmp_path / "out", AdviseConfig())


def test_too_few_patients_or_another_wire_leave_nothing_behind(folder, hold_slack, tmp_path) -> None:
    config = AdviseConfig(adviser=AdviserConfig(level=0.95))
    with pytest.raises(InputError, match="needs at least 19 patients"):
        advise(folder / "run", folder / "dataset", tmp_path / "out", config)
    record = {"config": {}, "networks": {}, "device": asdict(read_device("j-035"))}
    write_json(tmp_path / "manifest.json", record)
    with pytest.raises(InputError, match=r"its wire is workhorse-014, and that of .* is j-035"):
        advise(tmp_path, folder / "dataset", tmp_path / "out", AdviseConfig())
    assert not (tmp_path / "out").exists() and not (tmp_path / "xray.json").exists()
