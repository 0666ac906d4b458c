"""Motions that stay the same for some seconds: which are drawn, what they are judged by, and when they end."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from endopilot.belief.belief import Belief, BeliefConfig
from endopilot.control.agent_config import AgentConfig
from endopilot.control.population import ConstantMotions
from endopilot.control.trials import CATHETER, WIRE, Control, Move, Trials
from endopilot.simulation.world import World
from endopilot.tasks.navigation import Navigation
from endopilot.tasks.route import Route

BELIEF = BeliefConfig(members=1, stiffness_levels=1, element_mm=2.0, time_step_s=0.1)


def begin(navigation: Navigation, candidates: int = 16) -> tuple[ConstantMotions, Trials]:
    """Return candidates, and the devices where the navigation begins."""
    belief = Belief(navigation, [World()], BELIEF)
    one, many = (Trials.of(navigation, belief.kinds, count, like=belief.simulator) for count in (1, candidates))
    one.put(np.array([0]), belief.simulator, np.ones(1))
    route, config = Route.to(navigation.anatomy, navigation.target), AgentConfig.of(navigation).search
    return ConstantMotions(navigation, route, many, config, np.random.default_rng(0)), one


def only(motions: ConstantMotions, *controls: list[list[float]], monkeypatch: pytest.MonkeyPatch) -> None:
    """Let candidates draw some controls alone."""

    def draw(_: ConstantMotions) -> Control:
        return np.resize(np.array(controls), (motions.trials.count, 2, 2))

    monkeypatch.setattr(ConstantMotions, "_draw", draw)


def test_a_motion_ends_where_it_arrives(pair, monkeypatch) -> None:
    motions, one = begin(pair)
    one.move(one.control(Move(WIRE, 40.0)))  # 26 mm
    only(motions, [[0.5, 0.0], [0.0, 0.0]], [[7.0, 0.0], [0.0, 0.0]], monkeypatch=monkeypatch)
    controls, gain_mm = motions.best(one, 0.0, -np.inf)
    assert controls[0, WIRE, 0] == 7.0 and len(controls) < 4 and gain_mm == np.inf
    for number, control in enumerate(controls):
        assert not one.all(pair.reached(one.tips))[0], number
        one.move(control[None])
    assert one.all(pair.reached(one.tips))[0]


def test_the_catheter_is_worth_half_until_it_is_in_its_place(pair, monkeypatch) -> None:
    motions, one = begin(pair)
    one.move(one.control(Move(WIRE, 60.0)))
    only(motions, [[0.0, 0.0], [2.0, 0.0]], monkeypatch=monkeypatch)
    controls, gain_mm = motions.best(one, 30.0, -np.inf)
    assert controls.shape == (4, 2, 2) and gain_mm == pytest.approx(0.5 * 8.0, abs=0.3)  # 4 s of 2 mm/s
    assert motions.best(one, 4.0, -np.inf)[1] == pytest.approx(0.5 * 4.0, abs=0.3)
    assert abs(motions.best(one, -22.0, -np.inf)[1]) < 0.3  # it is there, and 30 mm deeper is as good
    assert motions.best(one, -30.0, -np.inf)[1] == pytest.approx(-0.5 * 8.0, abs=0.3)


def test_devices_that_press_on_are_best(pair, monkeypatch) -> None:
    """More than 10 mm of slack cost 0.1 a mm, less cost 0.2; beyond 40 mm a mm costs 0.4 more."""
    motions, one = begin(pair)
    only(motions, [[2.0, 0.0], [0.0, 0.0]], monkeypatch=monkeypatch)
    for progress_mm, cost in ((16.0, -0.2), (-14.0, 0.1), (-44.0, 0.5)):
        monkeypatch.setattr(Route, "progress", lambda _, tip, at=progress_mm: np.full(tip.abscissa.shape, at))
        assert motions.best(one, -100.0, -np.inf)[1] == pytest.approx(-cost * 8.0, abs=0.05)


def test_motions_go_on_for_as_long_again_where_none_comes_forward(pair, monkeypatch) -> None:
    """The tip is held until 10 mm were pushed, for 5 s, and then comes forward by 10 mm."""
    motions, one = begin(pair)
    only(motions, [[2.0, 0.0], [0.0, 0.0]], monkeypatch=monkeypatch)
    monkeypatch.setattr(Route, "progress", lambda _, tip: np.where(tip.abscissa > 16.0, 16.0, 6.0))
    for least_mm, periods, comes_mm in ((-np.inf, 4, 0.0), (3.0, 8, 10.0)):
        controls, gain_mm = motions.best(one, -100.0, least_mm)
        assert len(controls) == periods
        assert (gain_mm > 3.0) == (comes_mm > 0)


def test_in_the_second_look_the_wire_counts_alone_and_full_loops_are_not_pushed(pair, monkeypatch) -> None:
    motions, one = begin(pair)
    one.move(one.control(Move(WIRE, 60.0)))
    only(motions, [[0.0, 0.0], [2.0, 0.0]], monkeypatch=monkeypatch)
    assert motions.best(one, 30.0, 3.0)[1] > 3.0  # half of 8 mm
    assert abs(motions.best(one, 30.0, 5.0)[1]) < 0.3
    motions, one = begin(pair)
    only(motions, [[-2.0, 0.0], [0.0, 0.0]], [[2.0, 0.0], [0.0, 0.0]], monkeypatch=monkeypatch)
    monkeypatch.setattr(Route, "progress", lambda _, tip: np.full(tip.abscissa.shape, -44.0))
    motions.trials.copy_of(one)
    made = motions._unless_full(motions._draw())
    assert made[0, WIRE, 0] == -2.0 and made[1, WIRE, 0] == 0.0
    only(motions, [[2.0, 0.0], [0.0, 0.0]], monkeypatch=monkeypatch)
    pushed = [motions.best(one, -100.0, least_mm)[1] for least_mm in (-np.inf, 3.0)]
    assert pushed[0] == pytest.approx(pushed[1], abs=0.05) and pushed[0] < -1.0


def test_none_is_taken_that_presses_too_hard(pair, monkeypatch) -> None:
    motions, one = begin(replace(pair, force_limit_n=1e-9))
    only(motions, [[5.0, 0.0], [0.0, 0.0]], monkeypatch=monkeypatch)
    assert motions.best(one, 0.0, -np.inf)[1] == -np.inf


def test_what_was_best_is_tried_again_and_so_is_a_straight_push(pair) -> None:
    motions, one = begin(pair, candidates=400)
    best = motions.best(one, 0.0, -np.inf)[0][0]
    drawn = motions._draw()
    assert np.array_equal(drawn[0], best)
    assert np.array_equal(drawn[1], [[motions.config.speed_mm_s, 0.0], [0.0, 0.0]])
    rests, along = (drawn[2:, CATHETER] == 0).all(axis=1), drawn[2:, CATHETER, 0] == drawn[2:, WIRE, 0]
    assert 0.4 < rests.mean() < 0.65 and 0.2 < (along & ~rests).mean() < 0.35
    assert (drawn[:, WIRE, 1] > 0).any() and (drawn[:, WIRE, 1] < 0).any() and (drawn[:, WIRE, 0] < 0).any()
    assert np.abs(drawn[..., 1]).max() <= motions.trials.fastest[1]
