from __future__ import annotations

import json
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest

from endopilot.cli import main
from endopilot.dataset.loader import load_dataset
from endopilot.errors import InputError
from endopilot.evaluation.evaluate import EvaluateConfig, evaluate
from endopilot.evaluation.results import read_results
from endopilot.files import read_json, write_json
from endopilot.simulation.drive_limits import SPARE_MM
from toy_navigation import LENGTH_MM, toy_simulate


def test_metrics_are_on_disk_as_returned(evaluated):
    folder, metrics = evaluated
    text = (folder / "evaluation" / "metrics.json").read_text(encoding="utf-8")
    assert "NaN" not in text
    assert json.loads(text)["splits"]["test"]["tip"]["P1"]["abscissa"]["all"]["mae"] == pytest.approx(
        metrics["splits"]["test"]["tip"]["P1"]["abscissa"]["all"]["mae"]
    )


def test_both_splits_are_evaluated_on_episodes_that_no_network_saw(evaluated, toy_dataset):
    folder, metrics = evaluated
    dataset = load_dataset(toy_dataset)
    assert list(metrics["splits"]) == ["seen_test", "test"]
    trained = set(dataset.anatomy[dataset.split == "train"].tolist())
    assert not trained & set(metrics["splits"]["test"]["anatomies"])
    assert set(metrics["splits"]["seen_test"]["anatomies"]) <= trained
    for name, result in read_results(folder / "evaluation" / "evaluation.npz").items():
        for anatomy, sequence in zip(np.array(result.anatomies)[result.anatomy], result.sequence, strict=True):
            episode = (dataset.anatomy == anatomy) & (dataset.sequence == sequence)
            assert dataset.split[episode].tolist() == [name]


def test_sequences_are_spread_over_the_patients(evaluated):
    _, metrics = evaluated
    assert metrics["splits"]["test"]["episodes"] == 8
    assert len(metrics["splits"]["test"]["anatomies"]) == 2


def test_an_untrained_forward_network_is_the_baseline_it_corrects(evaluated):
    # Its guess is that slack and offset stay, so P1 must equal that baseline sample by sample.
    result = read_results(evaluated[0] / "evaluation" / "evaluation.npz")["test"]
    np.testing.assert_allclose(result.tips["P1"].abscissa, result.tips["hold_slack"].abscissa, atol=1e-3)
    np.testing.assert_allclose(result.tips["P1"].offset, result.tips["hold_slack"].offset, atol=1e-4)
    assert evaluated[1]["splits"]["test"]["tip"]["P1"]["abscissa"]["all"]["skill"]["hold_slack"] == pytest.approx(
        0.0, abs=1e-3
    )


def test_an_untrained_inverse_network_drives_as_the_tip_is_to_move(evaluated):
    result = read_results(evaluated[0] / "evaluation" / "evaluation.npz")["test"]
    np.testing.assert_allclose(result.controls["P2"], result.controls["follow_slack"], atol=1e-3)


def test_recorded_controls_lead_back_to_the_recorded_tips(evaluated):
    result = read_results(evaluated[0] / "evaluation" / "evaluation.npz")["seen_test"]
    assert np.abs(result.error("true_replay", "abscissa")).max() < 1e-3
    assert result.tip_distance["true_replay"].max() < 1e-3


def test_the_core_is_replayed_with_other_friction(toy_dataset, evaluated):
    asked = {}

    def watched(anatomy, device, control, *, initial, config, friction):
        asked[anatomy.name] = friction
        return toy_simulate(anatomy, device, control, initial=initial, config=config, friction=friction)

    with patch("endopilot.evaluation.replay.simulate", watched):
        metrics = evaluate(evaluated[0] / "run", evaluated[0] / "again", EvaluateConfig(sequences=2))
    true = load_dataset(toy_dataset).friction[0]
    for friction in asked.values():
        assert set(np.round(friction / true, 6).tolist()) == {0.9, 1.0, 1.1}
    assert {"friction_90", "friction_110"} <= metrics["splits"]["test"]["tip"].keys()


def test_patients_that_were_trained_on_are_told_from_new_ones(evaluated):
    splits = evaluated[1]["splits"]
    assert [split["title"] for split in splits.values()] == ["New navigations, known patients", "New patients"]
    assert splits["seen_test"]["known_patients"] == len(splits["seen_test"]["anatomies"])
    gap, tip = evaluated[1]["generalisation_gap"]["P1"]["abscissa"]["all"], [s["tip"]["P1"] for s in splits.values()]
    assert gap["difference"] == pytest.approx(tip[1]["abscissa"]["all"]["mae"] - tip[0]["abscissa"]["all"]["mae"])


def test_the_command_prints_errors_findings_and_paths(evaluated, monkeypatch, capsys):
    metrics = evaluated[1]
    monkeypatch.setattr("endopilot.cli.evaluate.evaluate", lambda *_: metrics)
    monkeypatch.setattr("endopilot.report.evaluation_report.report_evaluation", lambda _: None)
    with pytest.raises(SystemExit, match="0"):
        main(["evaluate", "r", "-o", "out"])
    printed = capsys.readouterr().out
    assert max(map(len, printed.splitlines())) <= 250
    for sentence in metrics["findings"]:
        assert sentence in printed
    row = next(line for line in printed.splitlines() if line.startswith("│ P4_replanned"))
    mae = metrics["splits"]["seen_test"]["tip"]["P4_replanned"]["abscissa"]["30-45"]["mae"]
    assert row.split("│")[4].strip() == f"{mae:.3f}"
    assert "out/report.html" in printed
    with pytest.raises(SystemExit, match="0"):
        main(["evaluate", "r", "-o", "out", "--json"])
    assert json.loads(capsys.readouterr().out)["splits"].keys() == metrics["splits"].keys()


def test_another_seed_stands_beside_the_run(evaluated):
    told = evaluated[1]["splits"]["test"]
    assert told["seeds"]["P1"]["abscissa"]["0-10"]["mae"] == [told["tip"]["P1"]["abscissa"]["0-10"]["mae"]] * 2
    assert told["seeds"]["P1"]["abscissa"]["0-10"]["sd"] == 0.0


def test_replayed_controls_are_simulated_from_the_start_of_the_episode(evaluated, toy_dataset):
    # The toy wire in closed form: Δtip = Δ − slack, with the slack of a play operator over the whole history.
    result = read_results(evaluated[0] / "evaluation" / "evaluation.npz")["test"]
    data = load_dataset(toy_dataset)
    name, sequence = result.anatomies[result.anatomy[0]], result.sequence[0]
    episode = data.select(np.flatnonzero((data.anatomy == name) & (data.sequence == sequence)))
    held = np.repeat(episode.control[:, 29:30], 90, axis=1)
    inserted = episode.inserted_length[:, 29, None] + 0.5 * np.cumsum(held[..., 0], axis=1)
    inserted = np.minimum(np.maximum(inserted, 0.0), LENGTH_MM + SPARE_MM)
    slack = inserted - result.tips["hold_control"].abscissa[:1]
    curliness = 0.02 + 0.005 * (len(name) % 3)
    assert (slack >= curliness * inserted - 1e-3).all()
    assert (slack <= curliness * inserted + 1.5 + 1e-3).all()


def test_a_run_without_its_dataset_is_told(evaluated, tmp_path):
    folder = evaluated[0]
    record = read_json(folder / "run" / "manifest.json")
    write_json(tmp_path / "manifest.json", record | {"dataset": "elsewhere"})
    with pytest.raises(InputError, match="is not here; name one with --dataset"):
        evaluate(tmp_path, tmp_path / "out", EvaluateConfig())
    assert not (tmp_path / "out").exists()


def test_the_packaged_model_asks_for_a_dataset(tmp_path):
    with pytest.raises(InputError, match="not in the package; name one with --dataset"):
        evaluate(Path("pretrained"), tmp_path / "out", EvaluateConfig())


@pytest.mark.parametrize("record", [None, {"config": {}, "stages": {}}])
def test_a_folder_that_is_no_run_is_told(tmp_path, record):
    if record is not None:
        write_json(tmp_path / "manifest.json", record)
    with pytest.raises(InputError, match=r"no finished run here .* make one with `endopilot train`"):
        evaluate(tmp_path, tmp_path / "out", EvaluateConfig())


@pytest.mark.parametrize(("field", "value"), [("sequences", 0), ("seed", -1)])
def test_bad_settings_are_named(field, value):
    with pytest.raises(InputError, match=field):
        EvaluateConfig(**{field: value})
