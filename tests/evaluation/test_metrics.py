from __future__ import annotations

import numpy as np
import pytest

from endopilot.evaluation import metrics

NAN = np.nan


def test_spans_hold_the_samples_after_the_given_states():
    spans = metrics.span_slices(90, 0.5)
    assert {name: (part.start, part.stop) for name, part in spans.items()} == {
        "0-10": (0, 20),  # the 20th prediction is 10 s after the last given state and still belongs here
        "10-30": (20, 60),
        "30-45": (60, 90),
    }


def test_spans_that_a_short_prediction_does_not_reach_are_left_out():
    assert list(metrics.span_slices(25, 0.5)) == ["0-10", "10-30"]
    assert metrics.span_slices(25, 0.5)["10-30"].stop == 25


def test_error_statistics_by_hand():
    found = metrics.error_statistics(np.array([[1.0, -1.0, NAN], [-3.0, 3.0, NAN]]))
    assert found["mae"] == 2.0
    assert found["sd"] == 1.0  # of |error| = 1, 1, 3, 3
    assert found["median"] == 2.0
    assert found["rmse"] == pytest.approx(np.sqrt(5.0))
    assert found["bias"] == 0.0
    assert found["count"] == 4


def test_p95_is_the_quantile_of_the_absolute_error():
    found = metrics.error_statistics(-np.arange(101.0)[None])
    assert found["p95"] == pytest.approx(95.0)


def test_no_sample_gives_none_and_not_zero():
    found = metrics.error_statistics(np.full((2, 3), NAN))
    assert found["count"] == 0
    assert found["mae"] is None


def test_skill_by_hand():
    baseline = np.array([[2.0, -2.0]])
    assert metrics.skill(np.zeros((1, 2)), baseline) == 1.0
    assert metrics.skill(np.array([[1.0, 1.0]]), baseline) == pytest.approx(0.5)
    assert metrics.skill(baseline, baseline) == pytest.approx(0.0)
    assert metrics.skill(np.array([[4.0, 4.0]]), baseline) == pytest.approx(-1.0)


def test_skill_compares_only_samples_that_both_have():
    assert metrics.skill(np.array([[1.0, NAN]]), np.array([[2.0, 50.0]])) == pytest.approx(0.5)


def test_skill_against_a_perfect_baseline_is_undefined():
    assert metrics.skill(np.ones((1, 2)), np.zeros((1, 2))) is None


def test_bootstrap_draws_patients_not_samples():
    # Two patients with errors 1 and 3: each draw's mean is 1, 2 or 3, so the interval is the whole range.
    error = np.repeat([[1.0], [3.0]], 100, axis=0) * np.ones((1, 50))
    found = metrics.bootstrap_intervals(error, np.repeat([0, 1], 100), seed=0)
    assert found["mae"] == found["rmse"] == found["p95"] == (1.0, 3.0)
    assert found["sd"] == (0.0, 1.0)  # of ones and threes alike


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


def test_bootstrap_needs_two_patients():
    assert metrics.bootstrap_intervals(np.ones((4, 5)), np.zeros(4, dtype=int), seed=0) is None


def test_diverged_counts_sequences_once_and_lost_ones_too():
    error = np.array([[0.0, 2.5, -9.0], [1.9, -1.9, 0.0], [0.0, NAN, NAN], [0.0, 0.0, -2.1]])
    assert metrics.diverged_share(error, np.isnan(error)) == 0.75


def test_quantiles_over_time_are_over_sequences():
    values = np.array([[0.0, NAN], [1.0, NAN], [2.0, NAN], [3.0, NAN], [4.0, NAN]])
    found = metrics.quantiles_over_time(values)
    assert (found["q25"][0], found["median"][0], found["q75"][0]) == (1.0, 2.0, 3.0)
    assert np.isnan(found["median"][1])


def test_control_rmse_of_each_sequence_in_mm_and_degrees():
    true = np.zeros((2, 2, 2))
    predicted = np.array([[[3.0, 0.0], [4.0, 0.0]], [[0.0, np.pi], [0.0, np.pi]]])
    found = metrics.control_rmse(predicted, true)
    np.testing.assert_allclose(found, [[np.sqrt(12.5), 0.0], [0.0, 180.0]])


def test_tip_statistics_normalises_by_the_radius_of_each_sample():
    error, radius = np.array([[1.0, 1.0]]), np.array([[1.0, 4.0]])
    found = metrics.tip_statistics(
        error, radius=radius, baselines={}, anatomy=np.array([0]), sample_period_s=0.5, seed=0
    )
    assert found["all"]["over_radius"]["mae"] == pytest.approx(0.625)
    assert found["all"]["over_radius"]["sd"] == pytest.approx(0.375)


def test_a_tip_that_sticks_slips_or_whips_is_distinguished_from_one_that_follows():
    # goes along; stays behind; springs ahead; all rest; the drive turns and the tip with it; the tip swings alone
    inserted = np.array([[0.0, 1.0, 2.0, 3.0, 3.0, 3.0, 3.0]])
    abscissa = np.array([[0.0, 1.0, 1.05, 3.2, 3.2, 3.2, 3.2]])
    rotation = np.array([[0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 1.0]])
    angle = np.array([[0.0, 0.1, 0.1, 0.3, 0.3, 1.3, 2.0]])
    direction = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=-1)
    found = metrics.tip_events(inserted, rotation, abscissa, direction)
    assert {name: np.flatnonzero(where[0]).tolist() for name, where in found.items()} == {
        "stick": [1],
        "slip": [2],
        "whip": [5],
    }
    back = metrics.tip_events(np.array([[5.0, 4.0]]), np.zeros((1, 2)), np.array([[4.0, 5.2]]), direction[:, :2])
    assert back["slip"].all()  # the other way


def test_errors_by_depth_hold_each_sample_once():
    error, depth = np.array([[1.0, -2.0, 3.0, NAN]]), np.array([[5.0, 30.0, 200.0, 10.0]])
    found = metrics.by_depth(error, depth)
    assert {name: (part["mae"], part["count"]) for name, part in found.items()} == {
        "0-30": (1.0, 1),
        "30-60": (2.0, 1),
        "60-90": (None, 0),
        "90-inf": (3.0, 1),
    }


def test_worst_anatomy():
    found = metrics.worst_anatomy(np.array([[1.0], [-5.0], [2.0]]), np.array([0, 1, 0]), ("good", "bad"))
    assert found == {"name": "bad", "mae": 5.0}
