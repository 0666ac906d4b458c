"""The agent in worlds that it does not know: who drives, what is counted, and what is printed of it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.agent import worlds
from benchmarks.agent.worlds import DrivenAtRandom, counted, drive_in_worlds, driven_on, figures, row
from endopilot.errors import InputError
from endopilot.navigation.loop import LoopConfig, NavigationLoop
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.world import World
from endopilot.tasks.navigation import Navigation, Target
from endopilot.tasks.task import list_tasks

CORE = SimulatorConfig(element_mm=1.5, time_step_s=0.05, threads=1)
GOOD = {"reason": "reached", "success": True, "safe": True, "seconds": 30.0, "exposures": 4, "peak_force_n": 0.1}
GOOD |= {"events": [4, 1], "decisions": [18, 20], "alarms": 0}


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


def test_figures_are_those_of_other_worlds_and_of_the_worst():
    rows = [
        row("nominal", "planned", [GOOD | {"alarms": 2}, GOOD]),
        row("nominal", "random", [GOOD]),
        row("wide", "planned", [GOOD, GOOD | {"success": False, "exposures": 50, "decisions": [0, 20]}]),
        row("wide", "random", [GOOD | {"events": [10, 0]}]),
        row("rough", "planned", [GOOD | {"safe": False, "peak_force_n": 0.9}, GOOD]),
        row("rough", "random", [GOOD | {"events": [10, 4], "exposures": 10}]),
    ]
    found = figures(rows)
    assert found["missed_share"] == 0.2 and found["missed_share_worst"] == 0.4
    assert found["exposures_per_minute_nominal"] == 8 and found["exposures_per_minute_other"] == 14
    assert found["safe_share"] == 0.5 and found["unsafe_by_force_share"] == 0.25
    assert found["exposures_planned"] == 15.5 and found["exposures_planned_nominal"] == 4
    assert found["navigations_above_40_exposures"] == 1
    assert found["in_bands_share_random"] == 0.9 and found["in_bands_share_planned"] == 0.675
    assert found["in_bands_share"] == 0.675 and found["in_bands_share_worst"] == 0.45
    assert found["false_alarms_share"] == pytest.approx(1 / 3, abs=1e-4) and found["alarms_share"] == 0
    assert "exposures_planned" not in figures([each for each in rows if each["drive"] == "random"])


def test_an_ostium_that_is_off_and_stated_walls_are_compared_with_the_truth():
    found = {"ostium_error_mm": 0.5, "wall_right": None}, {"ostium_error_mm": 0.2, "wall_right": False}
    rows = [
        row("nominal", "random", [GOOD | {"ostium_error_mm": None, "wall_right": True}]),
        row("deeper", "random", [GOOD | each for each in found]),
        row("deeper", "planned", [GOOD]),
    ]
    assert figures(rows)["ostium_error_mm"] == 0.35 and figures(rows)["wall_right_share"] == 0.5


def test_patients_are_those_of_no_task_and_of_one_set():
    known = {patients.seed for task in list_tasks() for patients in (task.ladder, task.training) if patients}
    seeds = [{seed for seed, _ in chosen.values()} for chosen in worlds.PATIENTS.values()]
    assert not seeds[0] & seeds[1] and not (seeds[0] | seeds[1]) & known
    for chosen in worlds.PATIENTS.values():
        assert sum(len(numbers) for _, numbers in chosen.values()) == worlds.PLACES
        assert list(chosen) == [task.name for task in list_tasks() if task.vessel in ("rca", "lca")]
    assert worlds.navigation_at("test", 7)[2] == 1000 * 20002 + 1


def write_good(path: Path, worlds: object, patients: object) -> None:
    path.write_text(json.dumps(GOOD | {"by": path.parent.name}))


def test_a_run_goes_on_and_prints_the_figures_with_their_bars(tmp_path, monkeypatch):
    made = []
    monkeypatch.setattr(worlds, "measure", write_good)

    def make_here(title, paths, make):
        made.append([path for path in paths if not path.exists()])
        for path in made[-1]:
            path.parent.mkdir(exist_ok=True, parents=True)
            make(path)

    monkeypatch.setattr(worlds, "make_missing", make_here)
    own = tmp_path / "own.yaml"
    own.write_text("about: a wide vessel\nlumen_factor: 1.2\n")
    out = tmp_path / "out"
    chosen = ("nominal", str(own))
    first = drive_in_worlds(output=out, planned=2, random=1, worlds=chosen)
    assert [path.relative_to(out).parts[:2] for path in made[0]] == [
        ("nominal", "planned"),
        ("nominal", "random"),
        ("own", "planned"),
        ("own", "random"),
        ("nominal", "planned"),
        ("own", "planned"),
    ]  # in turns
    assert len(first["worlds"]) == 4 and first["passed"]["missed_share"] is False and first["passed"]["safe_share"]
    drive_in_worlds(output=out, planned=3, random=1, worlds=chosen)
    assert len(made[1]) == 2
    own.write_text("lumen_factor: 1.3\n")
    with pytest.raises(InputError, match=r"was begun with world\.lumen_factor"):
        drive_in_worlds(output=out, planned=2, random=1, worlds=chosen)
