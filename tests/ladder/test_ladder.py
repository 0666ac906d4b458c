"""Climbing the ladder: scores, files that an interrupted run goes on from, and the page."""

from __future__ import annotations

import json
import shutil
import sys
from dataclasses import replace
from html import unescape

import numpy as np
import pytest

from command import output_of
from command import run as figures_of
from endopilot import __version__, runs
from endopilot.devices.device import read_wire
from endopilot.errors import InputError
from endopilot.files import read_json
from endopilot.ladder import attempt as attempts
from endopilot.ladder import terms
from endopilot.ladder.ladder import LadderConfig, climb
from endopilot.ladder.scores import score
from endopilot.ladder.submission import check_submission
from endopilot.ladder.table import tabulate
from endopilot.report.ladder_page import write_ladder_page
from endopilot.tasks.task import find_task, list_tasks
from endopilot.types import TipProjection
from toy_tasks import own_tasks

ONE = LadderConfig(policy="forward", tasks=("straight",), patients=1)


@pytest.fixture(scope="module")
def climbed(tmp_path_factory):
    """Return a folder in which `forward` did the lowest task in one patient, and its scores."""
    folder = tmp_path_factory.mktemp("ladder") / "forward"
    return folder, climb(output=folder, config=ONE)


def _result(success: bool, safe: bool, seconds: float = 10.0) -> dict:
    same = {"path_ratio": 1.2, "peak_force_n": 0.1, "exposures": 3}
    return {"success": success, "safe": safe, "seconds": seconds} | same


def test_pushing_solves_the_straight_run(climbed):
    folder, rows = climbed
    assert [row["task"] for row in rows] == ["straight"]
    row = rows[0]
    assert row["safe_success"] == row["success"] == 1.0
    target = find_task("straight")
    assert target.depth_mm is not None
    assert row["seconds"] == pytest.approx((target.depth_mm - target.start_inserted_length_mm) / 5.0, abs=1.0)
    assert 0.9 < row["path_ratio"] < 1.1 and 0 < row["peak_force_n"] < target.force_limit_n
    assert json.loads((folder / "ladder.json").read_text(encoding="utf-8"))["scores"] == rows


def test_an_interrupted_run_goes_on_with_what_is_missing(climbed, monkeypatch):
    folder, rows = climbed
    asked = []
    monkeypatch.setattr(runs, "each", lambda title, items, work, pool: asked.extend(items) or {})
    assert climb(output=folder, config=ONE) == rows
    assert asked == []


def test_a_folder_of_another_policy_or_of_something_else_is_refused(climbed, tmp_path):
    folder, _ = climbed
    with pytest.raises(InputError, match="was begun with policy = forward, now it is spin"):
        climb(output=folder, config=replace(ONE, policy="spin"))
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match=r"is not empty and holds no run\.json"):
        climb(output=tmp_path, config=ONE)


@pytest.mark.parametrize(
    ("name", "changed", "message"),
    [
        ("list_tasks", lambda _: tuple(replace(task, seconds=1.0) for task in list_tasks()), r"tasks\.straight = "),
        ("read_wire", lambda name: replace(read_wire(name), friction=0.5), r"tasks\.straight = "),
        ("__version__", "99.0", rf"version = {__version__}, now it is 99\.0"),
        ("NOTHING", None, r"tasks\.straight = "),  # but the version of the ladder
    ],
)
def test_a_folder_of_another_task_wire_or_version_is_refused(climbed, monkeypatch, name, changed, message):
    monkeypatch.setattr(runs if name == "__version__" else terms, name, changed, raising=False)
    version = 1 if name == "NOTHING" else 2
    with pytest.raises(InputError, match=f"was begun with {message}"):
        climb(output=climbed[0], config=replace(ONE, version=version))


def test_a_changed_policy_of_one_s_own_is_refused(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    policy = tmp_path / "my_changing_policy.py"
    policy.write_text("from endopilot.navigation.baseline_policies import Forward as Mine\n")
    one = replace(ONE, policy="my_changing_policy:Mine")
    climb(output=tmp_path / "runs", config=one)
    policy.write_text("from endopilot.navigation.baseline_policies import Spin as Mine\n")
    with pytest.raises(InputError, match=r"was begun with origin = my_changing_policy\.py sha256:"):
        climb(output=tmp_path / "runs", config=one)


def test_the_page_shows_the_scores_and_links_the_replay(climbed):
    folder, _ = climbed
    text = write_ladder_page(folder).read_text(encoding="utf-8")
    assert "The ladder: forward" in text and find_task("straight").title in text
    assert "replay-straight.html" in text and "data:image/png;base64," in text
    replay = (folder / "replay-straight.html").read_text(encoding="utf-8")
    assert "Guidewire" in replay and 'src="plotly.min.js"' in replay
    assert all(word in replay for word in ("Target", "Tip under X-ray", "safe success", "exposures: 1"))
    assert "1 of the ladder's 12 tasks, in 1 synthetic patient of each" in text
    assert "the tip's path in 1 patient" in unescape(text) and "1 patients" not in text
    assert (folder / "plotly.min.js").stat().st_size > 1e6


def test_safe_success_needs_both_and_medians_are_of_those_that_arrived():
    task = find_task("crux")
    results = [_result(True, True, 10.0), _result(True, False, 30.0), _result(False, True, 90.0), _result(False, False)]
    (row,) = score([task], {"crux": results})
    assert row["safe_success"] == 0.25 and row["success"] == 0.5
    assert row["seconds"] == 20.0 and row["exposures"] == 3.0
    (none,) = score([task], {"crux": [_result(False, True)]})
    assert none["safe_success"] == 0.0 and none["seconds"] is None and none["path_ratio"] is None


def test_missed_events_are_counted_over_all_navigations_of_the_agent():
    events = [(3, 1), (0, 0), (5, 1)]
    results = [_result(True, True) | {"events": pair, "planning_s": pair[0] / 2} for pair in events]
    (row,) = score([find_task("crux")], {"crux": results})
    assert row["missed_events"] == 0.25 and row["planning_s"] == 1.3
    (none,) = score([find_task("crux")], {"crux": [*results, _result(True, True)]})
    assert "missed_events" not in none  # one navigation was not watched


def test_the_events_of_a_navigation_are_at_the_wall_and_where_the_agent_errs():
    tip = TipProjection(
        offset=np.array([0.1, 0.1, 0.6, 0.6, 0.1, 0.1, 0.1, 0.6, 0.1]),  # of 0.82: at the wall from sample 2, and at 7
        radius=np.full(9, 1.0),
        abscissa=np.arange(9.0),
        branch=np.zeros(9, dtype=int),
    )
    exposed = np.array([1, 0, 0, 0, 0, 0, 1, 0, 0], dtype=bool)
    believed = np.arange(8.0)
    believed[5] += 2.0
    assert attempts.navigation_events(tip, exposed, believed, 0.18) == (2, 1)
    believed[4] += 2.0  # it begins sooner, before the exposure
    assert attempts.navigation_events(tip, exposed, believed, 0.18) == (2, 2)


def test_a_wire_that_begins_to_fill_the_lumen_is_an_event():
    radius = np.array([1.0, 1.0, 0.18, 0.18, 1.0, 1.0])
    tip = TipProjection(offset=np.zeros(6), radius=radius, abscissa=np.arange(6.0), branch=np.zeros(6, dtype=int))
    assert attempts.navigation_events(tip, np.zeros(6, dtype=bool), np.arange(5.0), 0.18) == (1, 1)


def test_the_upper_eight_are_summed_only_where_all_were_done():
    every = {task.name: [_result(task.level <= 6, True)] for task in list_tasks()}
    rows = {row["task"]: row for row in score(list_tasks(), every)}
    assert rows["lower four"]["safe_success"] == 1.0
    assert rows["upper eight"]["safe_success"] == 0.25
    assert rows["all twelve"]["safe_success"] == 0.5
    fewer = [task for task in list_tasks() if task.level != 9]
    assert "upper eight" not in {row["task"] for row in score(fewer, every)}


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"policy": "pray"}, "policy: 'pray'"),
        ({"tasks": ("moon",)}, "task: 'moon'"),
        ({"patients": 21}, "patients: 21"),
    ],
)
def test_bad_settings_are_refused(given, message):
    with pytest.raises(InputError, match=message):
        LadderConfig(**given)


def test_planning_time_is_scored_beside_what_a_submission_confirms(tmp_path):
    own_tasks(tmp_path / "mine", seconds=5.0)
    config = LadderConfig(policy="oracle", version=str(tmp_path / "mine"), patients=1)
    (row,) = climb(output=tmp_path / "run", config=config)
    (planned_s,) = (read_json(path)["planning_s"] for path in (tmp_path / "run").glob("along/*"))
    assert planned_s > 0 and row["planning_s"] == pytest.approx(planned_s, abs=0.06)
    assert "<th>Planning, s</th>" in write_ladder_page(tmp_path / "run").read_text(encoding="utf-8")
    assert "planning_s" not in (tmp_path / "run" / "submission.json").read_text(encoding="utf-8")
    assert check_submission(tmp_path / "run" / "submission.json").difference is None


def test_tasks_of_ones_own_are_climbed_scored_by_a_second_rule_and_checked(tmp_path):
    own_tasks(tmp_path / "mine", seconds=5.0)
    config = LadderConfig(policy="forward", version=str(tmp_path / "mine"))
    (row,) = climb(output=tmp_path / "run", config=config)
    # 5 mm/s for 5 s, from 2 to 27 mm: 20 mm is reached, 30 mm is not, but the tip comes within 5 mm of it.
    assert row["success"] == 0.5 and row["near"] == 1.0
    assert check_submission(tmp_path / "run" / "submission.json").difference is None
    page = write_ladder_page(tmp_path / "run").read_text(encoding="utf-8")
    assert "<th>Near, %</th>" in page and "a point for each patient" in page
    own_tasks(tmp_path / "mine", seconds=5.0, targets_mm=[[0, 0, 21], [0, 0, 30]])
    list_tasks.cache_clear()
    with pytest.raises(InputError, match=r"task 'along' of ladder .*mine is not the one here"):
        check_submission(tmp_path / "run" / "submission.json")


def test_without_the_libraries_of_its_page_a_ladder_says_what_is_left_out(climbed, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "plotly", None)  # as if it were not installed
    words = ["ladder", "--policy", "forward", "--tasks", "straight", "--patients", "1", "-o"]
    printed = output_of(capsys, *words, climbed[0])
    assert "submission" in printed
    assert {"task", "safe", "X-rays", "force", "time"} <= {*printed.split()}, "no word is cut"
    assert "left_out    the page, which needs: pip install 'endopilot[report]'" in printed


def test_the_table_is_made_of_what_was_driven_and_says_what_only_a_file_says(climbed, tmp_path, capsys):
    folder, (scores,) = climbed
    (row,) = tabulate(folder.parent)
    assert {name: row[name] for name in scores if name != "level"} == {k: v for k, v in scores.items() if k != "level"}
    assert (row["source"], row["navigations"]) == ("run", 1) and 0 < row["decision_ms"] <= row["p99_ms"]
    shutil.copytree(folder, tmp_path / "run")
    content = json.loads((tmp_path / "run" / "ladder.json").read_text(encoding="utf-8"))
    content["scores"][0]["safe_success"] = 0.5  # what is written by hand does not count
    (tmp_path / "run" / "ladder.json").write_text(json.dumps(content), encoding="utf-8")
    shutil.copy(folder / "submission.json", tmp_path / "mine.json")
    rows = figures_of(capsys, "ladder", "--table", "-o", tmp_path)
    file, *none, run = sorted(rows, key=lambda each: each["source"])
    assert run["safe_success"] == file["safe_success"] == 1.0
    assert (file["source"], file["decision_ms"], file["terms"]) == ("file", row["decision_ms"], run["terms"])
    tasks = [task.name for version in (2, "coaxial") for task in list_tasks(version)] + ["archvariety", "dualdevicenav"]
    assert [(each["policy"], each["source"]) for each in none] == [("forward", "none")] * 17
    assert sorted([*(each["task"] for each in none), "straight"]) == sorted(tasks)
    printed = output_of(capsys, "ladder", "--table", "-o", tmp_path)
    assert "\nas submissions say\n" in printed
    assert "\nNo row of forward, Public benchmark: archvariety, dualdevicenav\n" in printed
    assert max(len(line) for line in printed.splitlines() if not line.startswith("No row")) <= 80
    with pytest.raises(InputError, match="no run of `endopilot ladder` and no submission"):
        tabulate(tmp_path / "run" / "straight")
