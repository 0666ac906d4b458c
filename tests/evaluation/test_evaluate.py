"""A trained run rolled out by the protocols, and measured."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest

from command import output_of, run
from endopilot.dataset.loader import read_dataset
from endopilot.devices.robot import read_robot
from endopilot.errors import InputError
from endopilot.evaluation.evaluate import EvaluateConfig, Recorded, evaluate
from endopilot.evaluation.results import read_results
from endopilot.files import read_json, write_json
from endopilot.models.config import WINDOW
from endopilot.report.report import report_evaluation
from toy_navigation import make_toy_dataset, toy_run


def test_both_splits_are_evaluated_on_navigations_that_were_not_trained_on(evaluated, toy_dataset):
    folder, metrics = evaluated
    dataset = read_dataset(toy_dataset)
    assert list(metrics["splits"]) == ["seen_test", "test"]
    trained = set(dataset.anatomy[dataset.split == "train"].tolist())
    assert not trained & set(metrics["splits"]["test"]["anatomies"])
    assert set(metrics["splits"]["seen_test"]["anatomies"]) <= trained
    for name, result in read_results(folder / "evaluation" / "evaluation.npz").items():
        for anatomy, sequence in zip(np.array(result.anatomies)[result.anatomy], result.sequence, strict=True):
            episode = (dataset.anatomy == anatomy) & (dataset.sequence == sequence)
            assert dataset.split[episode].tolist() == [name]
    assert metrics["splits"]["test"]["episodes"] == 8 and len(metrics["splits"]["test"]["anatomies"]) == 2
    titles = [split["title"] for split in metrics["splits"].values()]
    assert titles == ["New navigations, known patients", "New patients"]
    split = metrics["splits"]["test"]  # another seed, the same run, stands beside it
    assert split["seeds"]["P1"]["abscissa"]["0-10"]["mae"] == [split["tip"]["P1"]["abscissa"]["0-10"]["mae"]] * 2


def test_an_untrained_forward_network_is_the_baseline_it_corrects(evaluated):
    # Its guess is that slack and offset stay, so P1 must equal that baseline sample by sample.
    result = read_results(evaluated[0] / "evaluation" / "evaluation.npz")["test"]
    np.testing.assert_allclose(result.tips["P1"].abscissa, result.tips["hold_slack"].abscissa, atol=1e-3)
    np.testing.assert_allclose(result.tips["P1"].offset, result.tips["hold_slack"].offset, atol=1e-4)
    assert evaluated[1]["splits"]["test"]["tip"]["P1"]["abscissa"]["all"]["skill"]["hold_slack"] == pytest.approx(
        0.0, abs=1e-3
    )
    # And the inverse network's is the baseline that drives as far as the tip is to move.
    np.testing.assert_allclose(result.controls["P2"], result.controls["follow_slack"], atol=1e-3)
    assert np.abs(result.error("true_replay", "abscissa")).max() < 1e-3
    assert result.tip_distance["true_replay"].max() < 1e-3


def test_the_core_is_replayed_with_other_friction(toy_dataset, evaluated):
    asked = {}

    def watched(set_up, command, **how):
        asked[set_up.anatomies[0].name] = set_up.friction
        return toy_run(set_up, command, **how)

    with patch("endopilot.dataset.loader.run_set_up", watched):
        metrics = evaluate(evaluated[0] / "run", output=evaluated[0] / "again", config=EvaluateConfig(sequences=2))
    true = read_dataset(toy_dataset).friction[0]
    for friction in asked.values():
        assert set(np.round(friction / true, 6).ravel().tolist()) == {0.9, 1.0, 1.1}
    assert {"friction_90", "friction_110"} <= metrics["splits"]["test"]["tip"].keys()


@pytest.fixture(scope="module")
def elsewhere(tmp_path_factory) -> Path:
    """Return a dataset of four patients, two of whom train."""
    folder = tmp_path_factory.mktemp("elsewhere") / "dataset"
    make_toy_dataset(folder, patients=4, sequences=4, anatomy_shares=(0.5, 0.25, 0.25))
    return folder


@pytest.fixture
def trained_on(evaluated, tmp_path):
    """Return what makes a run that was trained on some patients of a dataset."""

    def made(dataset: Path, names: set[str], name: str = "run") -> Path:
        run = tmp_path / name
        shutil.copytree(evaluated[0] / "run", run)
        patients = [sha for patient, sha in read_dataset(dataset).patients.items() if patient in names]
        write_json(run / "manifest.json", read_json(run / "manifest.json") | {"patients": patients})
        return run

    return made


def rows(result) -> set[tuple[str, int]]:
    return set(zip(np.array(result.anatomies)[result.anatomy].tolist(), result.sequence.tolist(), strict=True))


def chosen(dataset, mask) -> set[tuple[str, int]]:
    return set(zip(dataset.anatomy[mask].tolist(), dataset.sequence[mask].tolist(), strict=True))


def test_all_navigations_of_a_dataset_of_new_patients_are_evaluated(elsewhere, trained_on, tmp_path):
    dataset, out = read_dataset(elsewhere), tmp_path / "out"
    with patch("endopilot.dataset.loader.run_set_up", toy_run):
        metrics = evaluate(trained_on(elsewhere, set()), output=out, config=EvaluateConfig(), dataset=elsewhere)
    results = read_results(out / "evaluation.npz")
    assert {"train", "calibrate", "test"} <= set(dataset.split.tolist())
    assert list(metrics["splits"]) == list(results) == ["test"]
    assert rows(results["test"]) == chosen(dataset, np.ones(len(dataset), dtype=bool)) and len(dataset) == 16
    assert metrics["splits"]["test"]["known_patients"] == 0
    # there is no navigation that the run was trained on, and so no mean over them
    assert metrics["training_mean"] is None and "generalisation_gap" not in metrics
    assert "training_mean" not in results["test"].tips.keys() | results["test"].controls.keys()
    assert metrics["splits"]["test"]["tip"]["P1"]["abscissa"]["all"]["skill"].keys() == {"hold_slack"}
    with patch("endopilot.report.report.png", lambda _: b""):  # drawn, and not made pixels
        report_evaluation(out)
    assert "training mean" not in (out / "report.html").read_text(encoding="utf-8").lower()


def test_known_patients_among_new_ones_stay_known(elsewhere, trained_on, tmp_path):
    dataset = read_dataset(elsewhere)
    names = {str(dataset.anatomy[dataset.split == split][0]) for split in ("train", "calibrate", "test")}
    known, training = np.isin(dataset.anatomy, sorted(names)), dataset.split == "train"
    with patch("endopilot.dataset.loader.run_set_up", toy_run):
        metrics = evaluate(
            trained_on(elsewhere, names), output=tmp_path / "out", config=EvaluateConfig(), dataset=elsewhere
        )
    results = read_results(tmp_path / "out" / "evaluation.npz")
    assert rows(results["test"]) == chosen(dataset, ~known)
    assert rows(results["seen_test"]) == chosen(dataset, known & ~training)
    assert [metrics["splits"][split]["known_patients"] for split in ("seen_test", "test")] == [3, 0]
    assert "P1" in metrics["generalisation_gap"]
    # the mean is taken where the run was trained, not over what is evaluated
    trained = dataset[known & training]
    assert metrics["training_mean"] == {"navigations": len(trained), "patients": 1}
    for result in results.values():
        mean = trained.control.mean(axis=(0, 1, 2), dtype=float)
        np.testing.assert_allclose(result.controls["training_mean"][0, 0], mean)
        np.testing.assert_allclose(result.tips["training_mean"].offset, trained.tip_offset.mean(dtype=float))


def test_seeds_of_other_patients_are_refused(elsewhere, trained_on, tmp_path):
    first, second = (str(name) for name in np.unique(read_dataset(elsewhere).anatomy)[:2])
    run, other = trained_on(elsewhere, {first}), trained_on(elsewhere, {second}, "other")
    with pytest.raises(InputError, match=r"other: was trained on other patients than .*run; give runs of one training"):
        evaluate(run, output=tmp_path / "out", config=EvaluateConfig(), dataset=elsewhere, other_seeds=[other])
    assert not (tmp_path / "out").exists()


def test_a_dataset_that_was_trained_on_as_a_whole_is_refused(trained_on, tmp_path):
    make_toy_dataset(tmp_path / "all", patients=1, sequences=3, seen_test_share=0.0)
    names = set(read_dataset(tmp_path / "all").anatomy.tolist())
    with pytest.raises(InputError, match=r"was trained on all its navigations; make it with seen_test_share above 0"):
        evaluate(
            trained_on(tmp_path / "all", names),
            output=tmp_path / "out",
            config=EvaluateConfig(),
            dataset=tmp_path / "all",
        )


def test_the_command_prints_errors_findings_and_paths(evaluated, monkeypatch, capsys):
    metrics = evaluated[1]
    monkeypatch.setattr("endopilot.cli.data.evaluate", lambda *_, **__: metrics)
    monkeypatch.setattr("endopilot.report.report.report_evaluation", lambda _: None)
    printed = output_of(capsys, "evaluate", "r", "-o", "out")
    assert max(map(len, printed.splitlines())) <= 250
    for sentence in metrics["findings"]:
        assert sentence in printed
    row = next(line for line in printed.splitlines() if line.startswith("P2_replayed"))
    mae = metrics["splits"]["seen_test"]["tip"]["P2_replayed"]["abscissa"]["30-45"]["mae"]
    assert row.split()[3] == f"{mae:.3f}"
    assert "out/report.html" in printed
    assert run(capsys, "evaluate", "r", "-o", "out")["splits"].keys() == metrics["splits"].keys()


def test_controls_pass_the_drives_of_a_robot(toy_dataset):
    data = read_dataset(toy_dataset)
    data = data[(data.inserted_length[:, WINDOW - 1, 0] > 10) & (data.inserted_length[:, WINDOW - 1, 0] < 30)]
    data = data[:3]
    control = np.tile([2.0, 0.5], (3, 12, 1))
    control[:, 6:, 0] = -2.0
    control[1, 9:] = np.nan
    ideal = read_robot("ideal")
    robot = replace(ideal, latency_s=0.1, wire=replace(ideal.wire, play_mm=3.0, play_rad=0.4))
    made = Recorded.of(data, robot).drivable(control)
    assert np.isnan(made[1, 9:]).all() and np.isfinite(made[[0, 2]]).all()
    # v t less half the play on the way in, and v (t - latency) less all of it on the way back; it comes late by 0.1 s
    np.testing.assert_allclose(
        0.5 * made[0].sum(axis=0), [2 * 2.9 - 1.5 + 0.2 - (2 * 2.9 - 3.0), 0.5 * 5.9 - 0.2], atol=1e-3
    )
    np.testing.assert_array_equal(made[1, :9], Recorded.of(data, robot).drivable(control)[1, :9])
    exact = Recorded.of(data, ideal).drivable(control)[[0, 2]]
    np.testing.assert_allclose(exact, Recorded.of(data).drivable(control)[[0, 2]], atol=1e-4)


@pytest.mark.parametrize(
    ("run", "reason"),
    [
        ("wires", "trained on no dataset; name one with --dataset"),
        ("empty", r"no finished run here .* make one with `endopilot train`"),
        ("moved", "is not here; name one with --dataset"),
    ],
)
def test_a_run_without_a_dataset_is_refused(evaluated, tmp_path, run, reason):
    (tmp_path / "empty").mkdir()
    record = read_json(evaluated[0] / "run" / "manifest.json")
    write_json(tmp_path / "moved" / "manifest.json", record | {"dataset": "elsewhere"})
    with pytest.raises(InputError, match=reason):
        evaluate(Path(run) if run == "wires" else tmp_path / run, output=tmp_path / "out", config=EvaluateConfig())
    assert not (tmp_path / "out").exists()
