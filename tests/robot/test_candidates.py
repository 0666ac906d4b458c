from __future__ import annotations

import numpy as np

from endopilot.robot.candidates import Candidates, search

RANGES = {"slope": (0.0, 5.0), "nothing": (-1.0, 1.0)}


def line_costs(seed: int, episodes: int = 12):
    """Episodes of y = 2 x + noise, with a mean of its own for each: the cost knows nothing of the second parameter."""
    random = np.random.default_rng(seed)
    x = random.uniform(-1, 1, (episodes, 30))
    y = 2.0 * x + 0.3 * random.standard_normal(x.shape)

    def costs(values):
        error = y - values[:, 0, None, None] * x
        return (error**2).sum(axis=2)

    return costs, x, y


def found(seed: int, first: int = 64):
    costs, x, y = line_costs(seed)
    tried = search(costs, RANGES, first=first, rounds=3, draws=128, seed=seed)
    return tried.estimates({"slope": "mm"}), (x * y).sum() / (x**2).sum()


def test_the_least_cost_is_found_with_an_interval_as_long_as_the_noise_makes_it() -> None:
    held, widths = 0, []
    for seed in range(20):
        told, least_squares = found(seed)
        slope = told["slope"]
        assert abs(slope.value - least_squares) < 0.01
        held += slope.low <= 2.0 <= slope.high
        widths.append(slope.high - slope.low)
    standard_error = 0.3 / np.sqrt(12 * 30 / 3)  # of the slope, with x evenly drawn from -1 to 1
    assert held >= 17
    assert 0.6 < np.mean(widths) / (2 * 2.2 * standard_error) < 1.8  # a tenth of the candidates at least


def test_what_the_cost_does_not_depend_on_is_not_identified() -> None:
    told, _ = found(0)
    assert not told["nothing"].identified and told["slope"].identified
    assert str(told["nothing"]) == "not identifiable from this log"
    assert str(told["slope"]).endswith(" mm")


def test_an_episode_left_out_is_judged_by_the_candidate_of_all_others() -> None:
    costs = np.array([[0.0, 0.0, 9.0], [1.0, 1.0, 1.0]])
    assert Candidates({"x": (0.0, 1.0)}, np.zeros((2, 1)), costs).left_out.tolist() == [1.0, 1.0, 9.0]
