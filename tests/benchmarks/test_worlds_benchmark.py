"""The agent in worlds that it does not know: what is counted and printed of it; and the network that turns its wire."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.agent import turn_network, worlds
from benchmarks.agent.drawn_worlds import KINDS, drawn_world
from benchmarks.agent.turn_network import TURNS, Forks, fit
from benchmarks.agent.worlds import DrivenAtRandom, counted, driven_on, figures, identified, row
from endopilot.belief.identification import Identified
from endopilot.control.turn_network import AZIMUTH, FEATURES, ForkView
from endopilot.navigation.loop import LoopConfig, NavigationLoop
from endopilot.navigation.record import count_navigation_events
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.world import World
from endopilot.tasks.navigation import Navigation, Target
from endopilot.tasks.task import list_tasks

CORE = SimulatorConfig(element_mm=1.5, time_step_s=0.05, threads=1)
GOOD = {"reason": "reached", "success": True, "safe": True, "seconds": 30.0, "exposures": 4, "peak_force_n": 0.1}
GOOD |= {"events": {"contact": [3, 1, 2.0], "astray": [1, 0, 0.7], "force": [0, 0, 0.0]}, "events_before": [4, 0]}
GOOD |= {"decisions": [18, 20], "alarms": 0}
GOOD |= {"intervals": {"lumen_factor": True}}


@pytest.fixture(scope="module")
def at_random(fork, wire):
    """Return a function that drives at random for some seconds, past the target, and returns record and navigation."""

    def drive(seconds: float, monkeypatch: pytest.MonkeyPatch, world: World | None = None):
        monkeypatch.setattr(worlds, "SECONDS", seconds)
        # the wire begins a hair before the target: it is reached at once
        navigation = Navigation(
            anatomy=fork,
            device=wire,
            target=Target(branch=0, abscissa=6.0),
            start_inserted_length_mm=4.0,
            seconds=seconds,
        )
        loop = NavigationLoop(
            navigation, DrivenAtRandom(), config=LoopConfig(simulator=CORE), seed=3, world=world or World()
        )
        return driven_on(loop), navigation

    return drive


def test_a_wire_at_random_goes_on_past_its_target_and_is_shown_where_the_agent_asks(at_random, monkeypatch):
    record, navigation = at_random(8.0, monkeypatch)
    assert record.seconds == 8.0 and len(record.exposed) == 17
    away = np.abs(record.tip.abscissa[:, 0] - navigation.target.abscissa)
    assert away.min() < 2.0 and away.max() > 4.0  # there, and elsewhere
    again, _ = at_random(8.0, monkeypatch)
    np.testing.assert_array_equal(again.tip_position, record.tip_position)
    assert len(np.unique(record.control[:-1, 0], axis=0)) > 3  # no policy's course
    asked = np.array([bool(asks) for asks in record.asks[:-2]])
    np.testing.assert_array_equal(record.exposed[1 : len(asked) + 1], asked)
    assert record.exposed[0] and 1 <= record.exposures < 16


def test_decisions_without_bands_count_as_outside(at_random, monkeypatch):
    record, navigation = at_random(4.0, monkeypatch)
    whole = counted(record, navigation)
    assert whole["decisions"][1] == 8 and whole["alarms"] == 0
    lost = record.half_width.copy()
    lost[:6] = np.nan
    part = counted(replace(record, half_width=lost, asks=("model mismatch", *record.asks[1:])), navigation)
    assert part["decisions"][1] == 8 and part["decisions"][0] <= 2 and part["alarms"] == 1


def test_events_are_contacts_wrong_branches_and_forces_from_their_onset_on(at_random, monkeypatch):
    record, navigation = at_random(8.0, monkeypatch)
    nothing = np.zeros(17)
    tip = replace(record.tip, offset=np.zeros((17, 1)), radius=np.full((17, 1), 2.0))
    still = replace(record, tip=tip, astray_mm=nothing, contact_force_max=nothing, exposed=nothing > 0)
    assert all(each == (0, 0, 0.0) for each in count_navigation_events(still, navigation).values())
    touches, strays, presses = tip.offset.copy(), nothing.copy(), nothing.copy()
    touches[5:8], strays[9:12], presses[13] = 1.9, 30.0, 2 * navigation.force_limit_n  # 30 mm astray: another branch
    course = replace(still, tip=replace(tip, offset=touches), astray_mm=strays, contact_force_max=presses)
    before = np.isin(np.arange(17), [0, 4, 8, 12])
    found = count_navigation_events(replace(course, exposed=before), navigation)  # each 0.5 s too early
    assert {kind: each[:2] for kind, each in found.items()} == {"contact": (1, 1), "astray": (1, 1), "force": (1, 1)}
    assert found["contact"].missed_evenly == pytest.approx(1 - 2 * 3 / 15)
    for later in (1, 2):  # then, and 0.5 s after
        shown = np.roll(before, later)
        assert all(
            each.missed == 0 for each in count_navigation_events(replace(course, exposed=shown), navigation).values()
        )
    assert all(
        each.missed
        for each in count_navigation_events(replace(course, exposed=np.roll(before, 3)), navigation).values()
    )
    whole = counted(replace(course, exposed=before), navigation)
    assert row("wide", "random", [whole | identified(None, World(), None)])["missed"] == 3


def test_figures_are_those_of_other_worlds_and_of_the_worst():

    def missing(happened: int, missed: int) -> dict:
        none = [0, 0, 0.0]
        return GOOD | {"events": {"contact": [happened, missed, happened * 2 / 3], "astray": none, "force": none}}

    rows = [
        row("nominal", "planned", [GOOD | {"alarms": 2}, GOOD]),
        row("nominal", "random", [GOOD]),
        row("wide", "planned", [GOOD, GOOD | {"success": False, "exposures": 50, "decisions": [0, 20]}]),
        row("wide", "random", [missing(10, 0)]),
        row("rough", "planned", [GOOD | {"safe": False, "peak_force_n": 0.9}, GOOD]),
        row("rough", "random", [missing(10, 4) | {"exposures": 10}]),
    ]
    found, within = figures(rows)
    assert within[0]["share"] == "missed_share" and within[0]["of"] == 20
    assert (within[0]["from"], within[0]["to"]) == pytest.approx((0.0807, 0.416), abs=1e-4)  # Wilson, 4 of 20
    assert found["missed_share"] == 0.2 and found["missed_share_worst"] == 0.4
    assert found["exposures_per_minute_nominal"] == 8 and found["exposures_per_minute_other"] == 14
    assert found["safe_share"] == 0.5 and found["unsafe_by_force_share"] == 0.25
    assert found["missed_share_before"] == 0 and found["intervals_held_share"] == 1 and found["intervals"] == 9
    assert found["contacts_missed_share"] < found["contacts_missed_share_evenly"] == pytest.approx(2 / 3, abs=1e-4)
    assert found["exposures_planned"] == 15.5 and found["exposures_planned_nominal"] == 4
    assert found["navigations_above_40_exposures"] == 1
    assert found["in_bands_share_random"] == 0.9 and found["in_bands_share_planned"] == 0.675
    assert found["in_bands_share"] == 0.675 and found["in_bands_share_worst"] == 0.6
    assert found["false_alarms_share"] == pytest.approx(1 / 3, abs=1e-4) and found["alarms_share"] == 0
    assert "exposures_planned" not in figures([each for each in rows if each["drive"] == "random"])[0]


def test_an_ostium_that_is_off_and_stated_walls_are_compared_with_the_truth():
    found = {"ostium_error_mm": 0.5, "wall_right": None}, {"ostium_error_mm": 0.2, "wall_right": False}
    rows = [
        row("nominal", "random", [GOOD | {"ostium_error_mm": None, "wall_right": True}]),
        row("deeper", "random", [GOOD | each for each in found]),
        row("deeper", "planned", [GOOD]),
    ]
    assert figures(rows)[0]["ostium_error_mm"] == 0.35 and figures(rows)[0]["wall_right_share"] == 0.5
    stated = {
        "lumen_factor": (1.0, 1.2),
        "friction_factor": (0.5, 0.8),
        "tip_bend_factor": None,
        "drift_mm_min back": (0.5, 1),
    }
    said = Identified(stated, "compliant", explains=True, words="")
    wide = identified(said, World(ostium_mm=2.0, lumen_factor=1.1), 1.7)
    assert wide["ostium_error_mm"] == pytest.approx(0.3) and wide["wall_right"] is False
    assert wide["intervals"] == {"lumen_factor": True, "friction_factor": False, "drift_mm_min back": False}
    assert identified(said, World(drift_mm_min=(0.0, 0.7, 0.0)), None)["intervals"]["drift_mm_min back"]
    soft = identified(said, World(compliant_wall_n_mm2=0.01), 1.7)
    assert soft["ostium_error_mm"] is None and soft["wall_right"] is True
    nothing = identified(None, World(), None)
    assert nothing == {"ostium_error_mm": None, "wall_right": None, "intervals": {}}


def test_drawn_worlds_are_those_of_their_seed_and_have_every_kind_alone_and_with_another():
    drawn = [drawn_world(3, number) for number in range(2 * len(KINDS))]
    assert drawn == [drawn_world(3, number) for number in range(2 * len(KINDS))] != [drawn_world(4, 0), *drawn[1:]]
    alone, both = ([each.about for each in drawn if (" and " in each.about) is two] for two in (False, True))
    assert set(alone) == set(KINDS) and len(both) == len(KINDS)
    assert all(each.differences().keys() > {"about"} for each in drawn)


def test_patients_are_those_of_no_task_and_of_one_set():
    known = {patients.seed for task in list_tasks() for patients in (task.ladder, task.training) if patients}
    seeds = [{seed for seed, _ in chosen.values()} for chosen in worlds.PATIENTS.values()]
    assert not seeds[0] & seeds[1] and not (seeds[0] | seeds[1]) & known
    for chosen in worlds.PATIENTS.values():
        assert sum(len(numbers) for _, numbers in chosen.values()) == worlds.PLACES
        assert list(chosen) == [task.name for task in list_tasks() if task.vessel in ("rca", "lca")]
    assert worlds.navigation_at("test", 7)[2] == 1000 * 20002 + 1


def test_trials_before_a_fork_pass_on_some_sides_and_not_on_others(side_branch) -> None:
    rows = Forks(side_branch, np.random.default_rng(0)).drive()
    view, azimuth, passed = (np.array(column) for column in zip(*rows, strict=True))
    assert view.shape == (len(rows), FEATURES) and azimuth.shape == passed.shape == (len(rows), TURNS)
    before_fork = passed[0]
    assert before_fork.any() and not before_fork.all()
    # A wire that looks to the branch, at azimuth 0, passes rather than one that looks away.
    assert np.cos(azimuth[0][before_fork]).mean() > np.cos(azimuth[0][~before_fork]).mean() + 0.5


def test_the_network_learns_which_sides_pass(monkeypatch) -> None:
    """Sides within 1 rad of what the features say pass: the network finds them at forks it has not seen."""
    for name, few in (("EPOCHS", 25), ("NETWORKS", 1), ("WIDTH", 48)):
        monkeypatch.setattr(turn_network, name, few)
    random = np.random.default_rng(0)
    angle = random.uniform(-np.pi, np.pi, 400)
    view = 0.1 * random.standard_normal((400, FEATURES))
    view[:, 1], view[:, 2] = np.cos(angle), np.sin(angle)  # side and normal of a point of the route
    azimuth = 2 * np.pi * (np.arange(TURNS) / TURNS - 0.5) + np.zeros((400, 1))
    passed = np.cos(azimuth - angle[:, None]) > np.cos(1.0)
    network = fit(view[:300], azimuth[:300], passed[:300])
    best = [AZIMUTH[int(np.argmax(network.passes(ForkView(each, 0.0))))] for each in view[300:]]
    assert np.mean(np.cos(best - angle[300:]) > np.cos(1.0)) > 0.9
