from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from endopilot.errors import InputError
from endopilot.evaluation.results import (
    findings,
    generalisation_gap,
    over_seeds,
    read_results,
    summarize,
    write_results,
)
from endopilot.report import tables


def test_results_read_back_as_written(results, tmp_path):
    write_results(results, tmp_path / "evaluation.npz")
    read = read_results(tmp_path / "evaluation.npz")
    assert list(read) == ["seen_test", "test"]
    before, after = results["test"], read["test"]
    assert after.anatomies == before.anatomies
    assert set(after.tips) == set(before.tips)
    np.testing.assert_array_equal(after.tips["P4"].offset, before.tips["P4"].offset)
    np.testing.assert_array_equal(after.base_force["true"], before.base_force["true"])


def test_damaged_results_are_refused_in_one_line(tmp_path):
    path = tmp_path / "evaluation.npz"
    path.write_bytes(b"nothing")
    with pytest.raises(InputError, match=r"evaluation\.npz: damaged"):
        read_results(path)


def test_summary_is_plain_json_without_nan(results):
    json.dumps(summarize(results["test"], seed=0), allow_nan=False)


def test_several_seeds_stand_with_their_mean_and_spread(results):
    result = results["test"]
    tips = [replace(result.true, abscissa=result.true.abscissa + off) for off in (0.1, -0.2, 0.6)]
    found = over_seeds(result, tips)["abscissa"]["10-30"]
    np.testing.assert_allclose(found["mae"], [0.1, 0.2, 0.6])
    assert (found["mean"], found["sd"]) == (pytest.approx(0.3), pytest.approx(np.sqrt(0.07)))


def test_shares_of_events_are_reported(results):
    shares = summarize(results["test"], seed=0)["event_shares"]
    assert shares["stick"] == results["test"].events["stick"].mean() > shares["whip"] == 0.0


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
    assert "driving by the held slack" in found["New patients, P4"]


@pytest.fixture
def splits(results):
    return {split: summarize(result, seed=0) for split, result in results.items()}


def test_the_generalisation_gap_is_new_patients_error_against_known_ones(results, splits):
    gap = generalisation_gap(splits)["P4"]["offset"]
    known, new = (np.abs(results[split].error("P4", "offset")[:, 20:60]).mean() for split in ("seen_test", "test"))
    assert gap["10-30"] == {"difference": pytest.approx(new - known), "ratio": pytest.approx(new / known)}
    assert list(gap) == ["0-10", "10-30", "30-45", "all"]


def test_there_is_no_gap_without_both_kinds_of_patients(splits):
    assert generalisation_gap({"test": splits["test"]}) == {}
    assert generalisation_gap({"seen_test": splits["seen_test"]}) == {}


def test_drive_difference_table_holds_the_rmse_of_each_sequence(results):
    table = tables.rows(tables.drive_difference_table(results), split="test", series="P4")
    result = results["test"]
    expected = np.sqrt(np.mean((result.base_torque["P4"] - result.base_torque["true"]) ** 2, axis=1))
    np.testing.assert_allclose(tables.values(table, "torque_rmse_nmm"), expected)
    assert list(table["anatomy"]) == ["c"] * 6
    spread = summarize(result, seed=0)["drive"]["P4"]["torque_nmm"]["rmse_of_sequences"]
    assert spread["median"] == pytest.approx(np.median(expected))


def test_tip_error_table_holds_the_mean_over_sequences(results):
    table = tables.rows(tables.tip_error_table(results), split="test", series="P4")
    expected = np.abs(results["test"].error("P4", "abscissa")).mean(axis=0)
    np.testing.assert_allclose(tables.values(table, "abscissa_mae_mm"), expected)
    np.testing.assert_allclose(tables.values(table, "time_s")[[0, -1]], [0.5, 45.0])


def test_safety_table_holds_both_ratios(results):
    table = tables.rows(tables.safety_table(results), split="test", series="true")
    over_radius = tables.values(tables.rows(table, ratio="radius"), "median")
    over_clearance = tables.values(tables.rows(table, ratio="clearance"), "median")
    np.testing.assert_allclose(over_radius * 1.5, over_clearance * 1.32)


def test_a_wire_that_fills_the_lumen_is_at_the_wall_and_a_lost_tip_is_nowhere(results):
    true = results["test"].true
    filled = replace(true, radius=np.full_like(true.radius, 0.1), offset=true.offset.copy())
    filled.offset[:, 7] = np.nan
    table = tables.safety_table({"test": replace(results["test"], true=filled)})
    clearance = tables.rows(tables.rows(table, split="test", series="true"), ratio="clearance")
    for name in ("median", "p95"):
        values = tables.values(clearance, name)
        assert np.isnan(values[7]) and (np.delete(values, 7) == 1.0).all()
