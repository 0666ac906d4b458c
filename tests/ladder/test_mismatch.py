"""A policy on the ladder under model mismatch."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest

from endopilot.errors import InputError
from endopilot.ladder import ladder
from endopilot.ladder.ladder import CASES, LadderConfig, measure_mismatch, world_of
from endopilot.simulation.world import World
from endopilot.tasks.task import find_task

ONE = LadderConfig(policy="forward", tasks=("straight",), patients=1)


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    """Return a folder in which `forward` did the lowest task in one patient in three of the cases, and the rows."""
    folder = tmp_path_factory.mktemp("mismatch") / "forward"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ladder, "CASES", ("matched", "ostium-more", "all"))
        return folder, measure_mismatch(folder, ONE, 0.2)


def test_one_quantity_differs_at_a_time_then_all():
    task = find_task("straight")
    navigation = task.ladder_navigation(0)
    assert len(CASES) == 10

    def reality(case, share=0.2, place=0):
        return vars(world_of(case, share, navigation, task, place))

    matched = reality("matched")
    assert matched == vars(World())
    for case in CASES[1:-1]:
        now = reality(case)
        assert sum(now[name] != matched[name] for name in matched) == 1
    wide = 2 * navigation.anatomy.tree.branches[0].centerline.radius[0]
    assert reality("ostium-less")["ostium_mm"] == pytest.approx(-0.2 * wide)
    assert reality("stiffness-more")["tip_stiffness_factor"] == 1.2
    every = [reality("all", 0.1, place) for place in range(6)]
    assert {round(abs(one["friction_factor"] - 1), 9) for one in every} == {0.1}
    assert {round(one["latency_factor"], 9) for one in every} == {0.9, 1.1}


def test_a_row_a_case_and_a_deeper_wire_arrives_sooner(measured):
    folder, rows = measured
    assert [row["case"] for row in rows] == ["matched", "ostium-more", "all"]
    assert all(row["navigations"] == 1 and row["safe_success"] == 1.0 for row in rows)
    assert rows[1]["seconds"] < rows[0]["seconds"]
    content = json.loads((folder / "mismatch.json").read_text(encoding="utf-8"))
    assert content["cases"] == rows and content["mismatch"] == 0.2


def test_another_share_needs_another_folder(measured):
    folder, _ = measured
    with pytest.raises(InputError, match=r"was begun with mismatch = 0\.2, now it is 0\.3"):
        measure_mismatch(folder, ONE, 0.3)


def test_a_share_beyond_its_range_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"mismatch: 1\.5"):
        measure_mismatch(tmp_path / "new", ONE, 1.5)
    with pytest.raises(InputError, match="world: rough; mismatch makes worlds of its own"):
        measure_mismatch(tmp_path / "new", replace(ONE, world="rough"), 0.2)
    assert not (tmp_path / "new").exists()
