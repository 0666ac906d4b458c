"""Motions that are driven side by side: their steps, when a trial passes or is given up, what it costs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from endopilot.belief.belief import Belief, BeliefConfig
from endopilot.control.drive import Driver, Goal, Limits, Motions, Outcome, SearchConfig
from endopilot.control.repertoire import Draws, Repertoire, Row, read_table, sides
from endopilot.control.trials import CATHETER, WIRE, Trials
from endopilot.devices.catheter import read_catheter
from endopilot.simulation.world import World
from endopilot.tasks.navigation import DECISION_PERIOD_S, Navigation
from endopilot.tasks.route import Route

CONFIG = SearchConfig()
RANDOM = np.random.default_rng(0)


def drive(navigation: Navigation, row: Row, place: float, *, force_n: float = np.inf, periods: int = 60) -> Outcome:
    """Drive the motions of a row towards a place, from where the navigation begins; the obstacle lies at 20 mm."""
    belief, route = (
        Belief(navigation, [World()], BeliefConfig(members=1)),
        Route.to(navigation.anatomy, navigation.target),
    )
    trials = Trials.of(navigation, belief.kinds, row.count, like=belief.simulator)
    trials.put(np.zeros(1, dtype=int), belief.simulator, np.ones(1))
    motions = row.motions(20.0, 4.0, CONFIG, trials.devices, RANDOM)
    limits = Limits(force_n=force_n, off_mm=3.0, slack_mm=15.0)
    return Driver(trials, motions, Goal(navigation, route, place), limits, CONFIG).run(periods)


def test_a_motion_places_then_turns_then_retracts_then_pushes(side_branch) -> None:
    outcome = drive(side_branch, Row(at=(-1.0,), back=(0.5,), turns=2), 22.5)
    control = outcome.controls_of(1)  # not turned: it lies half a turn before the first
    placed = int(np.argmax(control[:, WIRE, 0] < 0))
    assert (control[:placed, WIRE, 0] > 0).all() and not control[:, WIRE, 1].any()
    begun = side_branch.start_inserted_length_mm
    assert begun + control[:placed, WIRE, 0].sum() * DECISION_PERIOD_S == pytest.approx(16.0, abs=1.1)
    assert placed == 2  # 14 mm at 20 mm/s; what turns back where slack is felt takes longer
    assert control[placed, WIRE, 0] * DECISION_PERIOD_S == pytest.approx(-2.0)
    assert (control[placed + 1 :, WIRE, 0] > 0).all()
    turned = outcome.controls_of(0)
    assert turned[:, WIRE, 1].sum() * DECISION_PERIOD_S == pytest.approx(-np.pi)
    assert not turned[turned[:, WIRE, 1] != 0, WIRE, 0].any()


def test_rotations_that_look_into_the_branch_pass_and_the_others_are_off(side_branch) -> None:
    outcome = drive(side_branch, Row(at=(-1.0,), turns=8), 22.5)
    passes = outcome.share == 1.0
    assert 0 < passes.sum() < 8 and {halt for halt, each in zip(outcome.halt, passes, strict=True) if not each} == {
        "off"
    }
    assert (outcome.farthest[~passes] < 22.5).all() and (outcome.to_go[~passes] > 0).all()
    best = int(np.argmin(outcome.expected_cost(0.5)))
    assert passes[best]
    beside = np.cos(sides(8) - sides(8)[best])
    assert passes @ beside == pytest.approx(max(passes @ np.cos(sides(8) - side) for side in sides(8)[passes]))


def test_a_trial_that_presses_too_hard_passes_nothing(side_branch) -> None:
    free = drive(side_branch, Row(), 12.0)
    assert free.share[0] == 1.0 and free.force[0] > 0
    pressed = drive(side_branch, Row(), 12.0, force_n=0.5 * float(free.force[0]))
    assert pressed.share[0] == 0.0 and pressed.halt == ["pressed"] and pressed.periods[0] <= free.periods[0]


def test_a_wire_that_folds_on_its_way_to_its_place_is_given_up(side_branch) -> None:
    """The place lies beyond the vessel's end."""
    outcome = drive(side_branch, Row(at=(50.0,)), 22.5)
    assert outcome.halt == ["stalled"] and outcome.slack[0] > 15.0 and outcome.periods[0] < 60


def test_a_wire_that_hardly_is_does_not_hold_the_others_back(side_branch) -> None:
    belief = Belief(side_branch, [World(), World(tip_stiffness_factor=0.8)], BeliefConfig(members=2))
    trials = Trials.of(side_branch, belief.kinds, 1, like=belief.simulator)
    for unlikely, counts in ((0.04, False), (0.06, True)):
        trials.put(np.arange(2), belief.simulator, np.array([1 - unlikely, unlikely]))
        assert trials.all(np.array([True, False])).tolist() == [not counts]


def test_a_wire_slows_down_before_the_target_and_stops_there(side_branch) -> None:
    straight = replace(side_branch, target=replace(side_branch.target, branch=0, abscissa=14.0))
    outcome = drive(straight, Row(), 14.0)
    speed = outcome.controls_of(0)[:, WIRE, 0]
    assert outcome.share[0] == 1.0 and speed[0] == CONFIG.speed_mm_s > speed[-1] and outcome.to_go[0] <= 1.5


def test_a_wire_that_comes_to_the_target_on_the_way_to_its_place_has_arrived(side_branch) -> None:
    """What it would do there, as to be retracted, leads away from the target."""
    straight = replace(side_branch, target=replace(side_branch.target, branch=0, abscissa=14.0))
    outcome = drive(straight, Row(at=(-1.5,), back=(2.0,)), 14.0)
    assert outcome.share[0] == 1.0 and outcome.to_go[0] <= 2.0
    assert (outcome.controls_of(0)[:, WIRE, 0] > 0).all()


def outcome_of(turn: np.ndarray, share: np.ndarray, **differs: np.ndarray) -> Outcome:
    """Return what became of made-up trials."""
    n, none = len(turn), np.zeros(len(turn))
    motions = Motions(np.full(n, np.nan), none, turn, none, none, np.zeros((n, 1, 2)))
    made = {"force": none, "to_go": none, "nearest": none, "slack": none, "periods": none.astype(int)} | differs
    return Outcome(motions, np.zeros((1, n, 1, 2)), share=share, farthest=none, halt=["late"] * n, **made)


def test_of_rotations_that_pass_the_one_in_the_middle_is_expected_to_cost_least() -> None:
    share = np.zeros(16)
    share[3:8] = 1.0
    assert np.argmin(outcome_of(sides(16), share).expected_cost(1.0)) == 5


@pytest.mark.parametrize("worse", ["force", "to_go", "slack", "periods"])
def test_pressing_lagging_slack_and_time_cost(worse) -> None:
    share = np.full(2, 0.5)
    made = outcome_of(np.array([0.0, np.pi]), share, **{worse: np.array([1, 3] if worse == "periods" else [1.0, 3.0])})
    cost = made.cost(1.0)
    assert cost[1] > cost[0]


def test_a_trial_that_comes_near_and_falls_off_costs_little_on_the_way() -> None:
    """Where it ends tells what goes on from there, where it came to what is drawn around it."""
    away, nearest = np.array([30.0, 10.0]), np.array([1.0, 10.0])
    made = outcome_of(np.array([0.0, np.pi]), np.zeros(2), to_go=away, nearest=nearest)
    assert np.argmin(made.cost(1.0)) == 1 and np.argmin(made.cost(1.0, on_the_way=True)) == 0


def test_a_row_combines_places_leads_and_rotations() -> None:
    row = Row(at=(-1.0, 2.0), lead_mm=(-3.0, -15.0), turns=4)
    made = row.motions(20.0, 5.0, CONFIG, 2, RANDOM)
    assert row.count == len(made.at_mm) == 16
    assert sorted(set(made.at_mm)) == [15.0, 30.0] and np.array_equal(made.turn_rad[:4], sides(4))
    # A wire that is placed deep in its catheter stays there; one at its mouth leads all along.
    assert set(made.follow_mm[made.lead_mm == -15.0]) == {-15.0} and (made.follow_mm[made.lead_mm == -3.0] > 100).all()


def test_later_rounds_are_drawn_near_the_best_and_some_anew() -> None:
    row, random = Row(at=(-2.0, 2.0), back=(0.0, 2.0), turns=1000, rounds=2), np.random.default_rng(1)
    first = row.motions(20.0, 5.0, CONFIG, 1, random)
    placed = first.at_mm[~np.isnan(first.at_mm)]
    assert 10.0 <= placed.min() < 10.5 and 29.5 < placed.max() <= 30.0 and 600 < len(placed) < 800
    at, none = np.array([12.0]), np.zeros(1)
    best = Motions(at, none, np.array([1.0]), np.array([5.0]), none, np.zeros((1, 1, 2)))
    later = row.motions(20.0, 5.0, CONFIG, 1, random, best)
    # Near: within two standard deviations, 7 % of the ranges 20 mm, 10 mm and a full turn.
    near = (abs(later.at_mm - 12.0) < 2.8) & (abs(later.back_mm - 5.0) < 1.4) & (abs(later.turn_rad - 1.0) < 0.88)
    assert near.mean() == pytest.approx(0.75 * 0.954**3, abs=0.05)
    assert np.isnan(later.at_mm).mean() == pytest.approx(0.3 * 0.25, abs=0.03)


def test_each_round_asks_for_fewer_wires() -> None:
    near = Row(at=(-2.0, 2.0), rounds=5, agree=0.5)
    assert [near.agrees(number) for number in range(5)] == [1.0, 0.875, 0.75, 0.625, 0.5]
    assert Row(agree=0.5).agrees(0) == 0.5
    for each in read_table().values():
        for row in (*each.rows, *each.drawn):
            assert all(0 < row.agrees(number) <= 1 for number in range(row.rounds))


def test_velocities_are_drawn_as_the_row_says() -> None:
    row = Row(turns=1000, draws=Draws(speeds=(-0.5, 1.0), spins=(-1.0, 0.0, 1.0)))
    made = row.motions(20.0, 5.0, CONFIG, 2, np.random.default_rng(1))
    assert np.isnan(made.follow_mm).all() and not made.turn_rad.any()
    assert made.velocity[0].tolist() == [[CONFIG.speed_mm_s, 0.0], [0.0, 0.0]]
    assert set(made.velocity[:, WIRE, 0]) == {-5.0, 10.0} and set(made.velocity[:, WIRE, 1]) == {-7.0, 0.0, 7.0}
    catheter = made.velocity[:, CATHETER, 0]
    assert (catheter == 0).mean() == pytest.approx(0.5, abs=0.05)
    assert (catheter == made.velocity[:, WIRE, 0]).mean() == pytest.approx(0.25 + 0.25 / 2, abs=0.05)


def test_each_kind_of_stack_and_lumen_has_a_table(side_branch) -> None:
    route = Route.to(side_branch.anatomy, side_branch.target)

    def rows(shape: str | None, *, together: bool = False) -> Repertoire:
        catheters = () if shape is None else (read_catheter(shape),)
        given = replace(side_branch, catheters=catheters)
        return Repertoire.of(given, route, replace(CONFIG, together=together), 10.0)

    alone, plain, shaped = rows(None), rows("microcatheter-1.7f"), rows("vertebral-5f")
    soft = rows("microcatheter-1.7f", together=True)
    assert len({alone, plain, shaped, soft}) == 4 and alone.drawn and soft.rows[0].draws and not plain.drawn
    assert alone.rows[0].count == 1 and alone.rows[0].off_radii == 0  # straight on, never off the route
