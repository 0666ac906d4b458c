"""The numbers of an evaluation against closed forms, and its figures in metrics.json."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from endopilot.errors import InputError
from endopilot.evaluation import metrics
from endopilot.evaluation.results import (
    findings,
    generalisation_gap,
    over_seeds,
    read_results,
    summarize,
    write_results,
)
from endopilot.report import figures

NAN = np.nan


def test_spans_hold_the_samples_after_the_given_states_as_far_as_a_prediction_reaches():
    spans = metrics.span_slices(90, 0.5)
    assert {name: (part.start, part.stop) for name, part in spans.items()} == {
        "0-10": (0, 20),  # the 20th prediction is 10 s after the last given state and still belongs here
        "10-30": (20, 60),
        "30-45": (60, 90),
    }
    assert list(metrics.span_slices(25, 0.5)) == ["0-10", "10-30"]
    assert metrics.span_slices(25, 0.5)["10-30"].stop == 25


def test_error_statistics_by_hand():
    found = metrics.error_statistics(np.array([[1.0, -1.0, NAN], [-3.0, 3.0, NAN]]))
    expected = {"mae": 2.0, "sd": 1.0, "median": 2.0, "rmse": pytest.approx(np.sqrt(5.0)), "bias": 0.0, "count": 4}
    assert found | expected == found  # of |error| = 1, 1, 3, 3
    assert metrics.error_statistics(-np.arange(101.0)[None])["p95"] == pytest.approx(95.0)
    none = metrics.error_statistics(np.full((2, 3), NAN))
    assert none["count"] == 0 and none["mae"] is None


def test_skill_by_hand():
    baseline = np.array([[2.0, -2.0]])
    assert metrics.skill(np.zeros((1, 2)), baseline) == 1.0
    assert metrics.skill(np.array([[1.0, 1.0]]), baseline) == pytest.approx(0.5)
    assert metrics.skill(baseline, baseline) == pytest.approx(0.0)
    assert metrics.skill(np.array([[4.0, 4.0]]), baseline) == pytest.approx(-1.0)
    # of the samples that both have; against a perfect baseline it is undefined
    assert metrics.skill(np.array([[1.0, NAN]]), np.array([[2.0, 50.0]])) == pytest.approx(0.5)
    assert metrics.skill(np.ones((1, 2)), np.zeros((1, 2))) is None


def test_bootstrap_intervals_are_those_of_patients_put_together_again():
    random = np.random.Generator(np.random.Philox(3))
    error, anatomy = random.normal(size=(40, 9)) ** 3, np.arange(40) % 7
    error[5, 3] = error[6] = NAN
    found = metrics.bootstrap_intervals(error, anatomy, seed=8, draws=60)
    chosen = np.random.Generator(np.random.Philox(8)).integers(7, size=(60, 7))
    drawn = [metrics.error_statistics(np.concatenate([error[anatomy == name] for name in row])) for row in chosen]
    for name in ("mae", "sd", "rmse", "p95"):
        expected = np.quantile([one[name] for one in drawn], [0.025, 0.975])
        np.testing.assert_allclose(found[name], expected, rtol=0.1 if name == "p95" else 1e-9)
    assert metrics.bootstrap_intervals(error, np.zeros(40, dtype=int), seed=8) is None  # of one patient


def test_diverged_counts_sequences_once_and_lost_ones_too():
    error = np.array([[0.0, 2.5, -9.0], [1.9, -1.9, 0.0], [0.0, NAN, NAN], [0.0, 0.0, -2.1]])
    assert metrics.diverged_share(error, np.isnan(error)) == 0.75


def test_control_rmse_of_each_sequence_in_mm_and_degrees():
    true = np.zeros((2, 2, 2))
    predicted = np.array([[[3.0, 0.0], [4.0, 0.0]], [[0.0, np.pi], [0.0, np.pi]]])
    found = metrics.control_rmse(predicted, true)
    np.testing.assert_allclose(found, [[np.sqrt(12.5), 0.0], [0.0, 180.0]])


def test_results_read_back_as_written(results, tmp_path):
    write_results(results, tmp_path / "evaluation.npz")
    read = read_results(tmp_path / "evaluation.npz")
    assert list(read) == ["seen_test", "test"]
    before, after = results["test"], read["test"]
    assert after.anatomies == before.anatomies
    assert set(after.tips) == set(before.tips)
    np.testing.assert_array_equal(after.tips["P4"].offset, before.tips["P4"].offset)
    np.testing.assert_array_equal(after.tip_distance["P4"], before.tip_distance["P4"])
    json.dumps(summarize(after, seed=0), allow_nan=False)
    (tmp_path / "evaluation.npz").write_bytes(b"nothing")
    with pytest.raises(InputError, match=r"evaluation\.npz: no evaluation"):
        read_results(tmp_path / "evaluation.npz")


def test_several_seeds_stand_with_their_mean_and_spread(results):
    result = results["test"]
    tips = [replace(result.true, abscissa=result.true.abscissa + off) for off in (0.1, -0.2, 0.6)]
    found = over_seeds(result, tips)["abscissa"]["10-30"]
    np.testing.assert_allclose(found["mae"], [0.1, 0.2, 0.6])
    assert (found["mean"], found["sd"]) == (pytest.approx(0.3), pytest.approx(np.sqrt(0.07)))


def test_lost_samples_make_a_sequence_diverged(results):
    result = results["test"]
    result.tips["P1"].abscissa[0, 5:] = np.nan
    try:
        tip = summarize(result, seed=0)["tip"]["P1"]
    finally:
        result.tips["P1"].abscissa[0, 5:] = result.true.abscissa[0, 5:]
    assert tip["diverged_share"] == pytest.approx(1 / 6)
    assert tip["lost_share"] == pytest.approx(85 / (6 * 90))


def test_findings_say_where_a_baseline_wins(results):
    metrics = {"splits": {"test": {"title": "New patients"} | summarize(results["test"], seed=0)}}
    found = {sentence.split(":")[0]: sentence for sentence in findings(metrics)}
    assert "Δtip beats every baseline" in found["New patients, P1"]
    assert "Δtip loses to a baseline" in found["New patients, P4"]
    assert "against baseline: drive by the held slack" in found["New patients, P4"]


@pytest.fixture
def splits(results):
    return {split: summarize(result, seed=0) for split, result in results.items()}


def test_the_generalisation_gap_is_new_patients_error_against_known_ones(results, splits):
    gap = generalisation_gap(splits)["P4"]["offset"]
    known, new = (np.abs(results[split].error("P4", "offset")[:, 20:60]).mean() for split in ("seen_test", "test"))
    assert gap["10-30"] == {"difference": pytest.approx(new - known), "ratio": pytest.approx(new / known)}
    assert list(gap) == ["0-10", "10-30", "30-45", "all"]
    for kind, split in splits.items():  # there is none of one kind alone
        assert generalisation_gap({kind: split}) == {}


def test_a_wire_that_fills_the_lumen_is_at_the_wall_and_a_lost_tip_is_nowhere(results):
    true = results["test"].true
    filled = replace(true, radius=np.full_like(true.radius, 0.1), offset=true.offset.copy())
    filled.offset[:, 7] = np.nan
    table = figures.safety_table({"test": replace(results["test"], true=filled)})
    clearance = table.query("split == 'test' and series == 'true' and ratio == 'clearance'")
    for name in ("median", "p95"):
        values = np.asarray(clearance[name])
        assert np.isnan(values[7]) and (np.delete(values, 7) == 1.0).all()
