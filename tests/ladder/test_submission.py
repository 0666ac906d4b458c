"""A submission's scores are confirmed by its recordings; what was changed in the file is refused or named."""

from __future__ import annotations

import hashlib
import json
import sys
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from endopilot.cli import main
from endopilot.devices.device import read_wire
from endopilot.errors import InputError
from endopilot.files import json_text
from endopilot.ladder import submission
from endopilot.ladder.attempt import Recording, attempt, repeat
from endopilot.ladder.ladder import LadderConfig, climb
from endopilot.ladder.submission import check_submission
from endopilot.tasks.task import find_task

_POLICY = """
import numpy as np
from endopilot.navigation.policy import Decision

class Hurried:
    def start(self, navigation, seed):
        self.random = np.random.default_rng(seed)
    def decide(self, observation):
        translation, rotation = self.random.normal([9.0, 0.0], [3.0, 2.0])
        return Decision(((translation, rotation),), expose=observation.time_s % 2.0 == 0.5)
"""


@pytest.fixture(scope="module")
def written(tmp_path_factory) -> dict:
    """Return the content of the submission of `forward` in the first patient of two tasks."""
    folder = tmp_path_factory.mktemp("submission")
    climb(output=folder, config=LadderConfig(policy="forward", tasks=("straight", "descending"), patients=1))
    return json.loads((folder / "submission.json").read_text(encoding="utf-8"))


@pytest.fixture
def changed(written, tmp_path):
    """Return a function that writes a changed copy of the submission and checks it."""

    def check(change) -> submission.SubmissionCheck:
        content = json.loads(json.dumps(written))
        change(content)
        path = tmp_path / "submission.json"
        path.write_text(json.dumps(content), encoding="utf-8")
        return check_submission(path)

    return check


def _first(content: dict) -> dict:
    return content["navigations"]["straight"][0]


def _record(content: dict, change) -> None:
    """Change the first navigation's recording."""
    entry = _first(content)
    recording = Recording.unpacked(entry["recording"])
    control, exposed = recording.control.copy(), recording.exposed.copy()
    control, exposed = change(control, exposed)
    entry["recording"] = Recording(control, exposed, None).packed()


def _at(row: int, column: int, factor: float):
    def change(control, exposed):
        control[row, 0, column] = control[row, 0, column] * factor + (factor - 1)
        return control, exposed

    return change


def _swap_exposures(control, exposed):
    exposed[3] = True
    return control, exposed


def test_a_submission_is_confirmed_in_other_processes(written, tmp_path, in_processes):
    path = tmp_path / "submission.json"
    path.write_text(json.dumps(written), encoding="utf-8")
    found = check_submission(path)
    assert found.difference is None and found.navigations == 2 and found.remarks == ()
    assert found.policy == "forward" and found.origin.startswith("endopilot ")
    assert {row["task"] for row in written["scores"]} == {"straight", "descending"}


def test_a_file_of_version_1_is_driven_again_in_the_textbook_s_patients(tmp_path):
    climb(output=tmp_path, config=LadderConfig(policy="forward", tasks=("straight",), patients=1, version=1))
    path = tmp_path / "submission.json"
    content = json.loads(path.read_text(encoding="utf-8"))
    del content["ladder"]  # as files were before there was a version 2
    path.write_text(json.dumps(content), encoding="utf-8")
    assert check_submission(path).difference is None
    path.write_text(json.dumps(content | {"ladder": 2}), encoding="utf-8")
    with pytest.raises(InputError, match="task 'straight' is not the one of endopilot"):
        check_submission(path)


def test_a_version_1_task_has_the_hash_of_its_file_before_there_were_versions():
    since = ("version", "catheter", "arrives", "start_catheter_mm", "anatomies", "targets_mm", "near_mm")
    task = find_task("crux", version=1)
    then = {"vessel": "anatomy", "start_inserted_length_mm": "start_inserted_mm"}
    before = {then.get(name, name): value for name, value in asdict(task).items() if name not in since}
    content = json_text(before) + json_text(read_wire(task.device))
    assert submission.task_digest(task) == hashlib.sha256(content.encode()).hexdigest()
    assert submission.task_digest(task) != submission.task_digest(replace(task, version=2))


@pytest.mark.parametrize(
    ("change", "difference"),
    [
        (lambda c: _first(c).update(peak_force_n=0.0123), "peak_force_n is 0.0123 in the file and 0."),
        (lambda c: _first(c).update(path_ratio=np.nextafter(_first(c)["path_ratio"], 2)), "path_ratio is "),
        (lambda c: _first(c).update(exposures=0), "exposures is 0 in the file and 1 when driven again"),
        (lambda c: _first(c).update(success=False), "success is false in the file and true"),
        (lambda c: _first(c).update(patient="nobody"), 'patient is "nobody" in the file'),
        (lambda c: _first(c).update(events=[3, 0]), "events is "),
        (lambda c: _first(c).update(sha256="0" * 64), "decisions or course are not those"),
        (lambda c: _record(c, _at(4, 0, 1 + 1e-12)), ""),
        (lambda c: _record(c, _at(4, 1, 1 + 1e-12)), ""),
        (lambda c: _record(c, _swap_exposures), "exposures is 1 in the file and 2"),
        (lambda c: _record(c, lambda v, x: (v[:-1], x[:-1])), "decisions, and the navigation goes on"),
        (lambda c: _record(c, lambda v, x: (np.vstack([v, v]), np.hstack([x, x]))), "and the navigation ends after"),
        (lambda c: _record(c, lambda v, x: (v, ~x)), "X-ray is off at the first decision"),
        (lambda c: _first(c)["recording"].update(control="AAAA"), "control: no recorded array"),
    ],
)
def test_a_changed_navigation_is_named(changed, change, difference):
    found = changed(change).difference
    assert found.startswith("task straight, patient 0: ") and difference in found
    assert found.endswith("(1 of 2 navigations differ)")


def test_the_first_of_several_navigations_is_named_by_level(changed):
    def both(content):
        content["navigations"] = dict(reversed(content["navigations"].items()))
        for done in content["navigations"].values():
            done[0]["seconds"] += 0.5

    found = changed(both).difference
    assert found.startswith("task straight, patient 0: seconds is") and found.endswith("(2 of 2 navigations differ)")


def test_a_changed_score_is_named(changed):
    assert (
        "scores, descending: safe_success is " in changed(lambda c: c["scores"][1].update(safe_success=0.5)).difference
    )
    more = {"level": None, "task": "all twelve", "safe_success": 1.0}
    assert "scores, all twelve: level is null" in changed(lambda c: c["scores"].append(more)).difference


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: _first(c).update(seed=101), "task straight, patient 0: seed 101; the ladder's is 100"),
        (lambda c: c["tasks"].update(straight="0" * 64), "task 'straight' is not the one of endopilot"),
        (lambda c: c["tasks"].pop("straight"), "tasks and navigations name different tasks"),
        (lambda c: c["navigations"]["straight"].append(_first(c)), "needs the same first 1 to 20 patients"),
        (lambda c: c.update(format=2), "format: 2; choose from 1, or give a submission.json"),
        (lambda c: c.update(extra=1), "extra: no such field; the fields are format"),
        (lambda c: c.pop("policy"), "policy: missing; add it"),
        (
            lambda c: _first(c)["recording"].pop("control"),
            r"navigations\.straight\[0\]\.recording\.control: missing; add it",
        ),
    ],
)
def test_what_is_no_submission_of_this_ladder_is_refused(changed, change, message):
    with pytest.raises(InputError, match=message) as refusal:
        changed(change)
    assert "\n" not in str(refusal.value)


def test_another_task_s_name_is_refused(changed):
    def rename(content):
        for key in ("tasks", "navigations"):
            content[key]["moon"] = content[key].pop("straight")

    with pytest.raises(InputError, match=r"submission\.json: task: 'moon'; choose from"):
        changed(rename)


def test_other_versions_are_stated(changed):
    def older(content):
        content["versions"] |= {"endopilot": "0.0.1", "numpy": "1.0"}
        content["core"], content["blas"] = "another", "a third"

    found = changed(older)
    assert found.difference is None
    assert [remark.split(",")[0] for remark in found.remarks] == [
        "made with endopilot 0.0.1", "made with numpy 1.0", "made with core another", "made with blas a third",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("change", "kernel", "confirmed"),
    [
        ({"path_ratio": 1e-7}, "another", True),
        ({"path_ratio": 1e-7}, None, True),  # older files name none
        ({"path_ratio": 1e-7}, "this", False),
        ({"path_ratio": 0.06}, "another", False),
        ({"peak_force_n": 0.06}, "another", False),
        ({"exposures": 1.0}, "another", False),
    ],
)
def test_with_another_kernel_figures_agree_but_for_rounding(changed, change, kernel, confirmed):
    def alter(content):
        first = _first(content)
        for name, share in change.items():
            first[name] = type(first[name])(first[name] * (1 + share))
        content["blas"] = submission.blas_kernel() if kernel == "this" else kernel

    found = changed(alter)
    assert found.difference is not None and found.confirmed == confirmed


def test_scores_that_do_not_follow_are_not_confirmed_with_another_kernel(changed):
    def alter(content):
        content["blas"] = "another"
        _first(content)["path_ratio"] *= 1 + 1e-7
        content["scores"][0]["exposures"] += 1

    found = changed(alter)
    assert found.difference.startswith("scores, ") and not found.confirmed


def test_a_policy_of_one_s_own_climbs_and_its_submission_is_confirmed(tmp_path, monkeypatch, capsys):
    (tmp_path / "hurried.py").write_text(_POLICY)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    flags = ["ladder", "--policy", "hurried:Hurried", "--tasks", "straight", "--patients", "1", "--no-page"]
    with pytest.raises(SystemExit) as leaving:
        main(flags)
    assert leaving.value.code == 0
    file = tmp_path / "runs" / "ladder" / "hurried.Hurried" / "submission.json"
    assert str(file.relative_to(tmp_path)) in capsys.readouterr().out
    content = json.loads(file.read_text(encoding="utf-8"))
    assert content["origin"].startswith("hurried.py sha256:") and _first(content)["exposures"] > 1
    Path("hurried.py").unlink()  # the check does not need the policy
    del sys.modules["hurried"]
    check = ["ladder", "--check", str(file), "--json"]
    with pytest.raises(SystemExit) as leaving:
        main(check)
    assert leaving.value.code == 0
    assert json.loads(capsys.readouterr().out)["confirmed"] is True
    _first(content)["seconds"] += 0.5
    file.write_text(json.dumps(content), encoding="utf-8")
    with pytest.raises(SystemExit) as leaving:
        main(check)
    assert leaving.value.code == 1
    printed = json.loads(capsys.readouterr().out)
    assert printed["confirmed"] is False and "seconds is" in printed["difference"]


def test_the_agent_s_believed_tips_give_its_missed_events_again():
    navigation = replace(find_task("straight").ladder_navigation(0), seconds=3.0)
    result = attempt("agent", navigation, seed=100)
    recording = Recording.unpacked(result["recording"])
    assert recording.believed_mm is not None
    figures = repeat(recording, navigation, seed=100)
    assert figures == {name: result[name] for name in figures} and "events" in figures
    errs = np.where(np.arange(len(recording.exposed)) > 2, 5.0, 0.0)
    elsewhere = Recording(recording.control, recording.exposed, recording.believed_mm + errs)
    assert repeat(elsewhere, navigation, seed=100)["events"] != figures["events"]


def test_a_recording_is_kept_to_the_bit():
    random = np.random.default_rng(0)
    recording = Recording(random.normal(size=(180, 1, 2)), np.arange(180) % 7 == 0, random.normal(size=180))
    again = Recording.unpacked(json.loads(json.dumps(recording.packed())))
    for name in ("control", "exposed", "believed_mm"):
        np.testing.assert_array_equal(getattr(again, name), getattr(recording, name))
    assert len(json.dumps(recording.packed())) < 8000  # 240 of them are less than 2 MB


def test_a_ladder_in_another_world_is_confirmed_in_it(written, tmp_path):
    world = tmp_path / "world.yaml"
    world.write_text("lumen_factor: 1.1\nostium_mm: 1.0\nbacks_out_mm: 1.0\nbacks_out_after_s: 1.0\n", encoding="utf-8")
    config = LadderConfig(policy="forward", tasks=("straight",), patients=1, world=str(world))
    climb(output=tmp_path / "ladder", config=config)
    path = tmp_path / "ladder" / "submission.json"
    content, scores = (
        json.loads((path.with_name(name)).read_text(encoding="utf-8")) for name in (path.name, "ladder.json")
    )
    differs = {"lumen_factor": 1.1, "ostium_mm": 1.0, "backs_out_mm": 1.0, "backs_out_after_s": 1.0}
    assert scores["world"] == {"name": str(world)} | differs
    assert _first(content)["sha256"] != _first(written)["sha256"]
    assert check_submission(path).difference is None
    content["world"]["lumen_factor"] = 1.05
    path.write_text(json.dumps(content), encoding="utf-8")
    assert check_submission(path).difference is not None
    with pytest.raises(InputError, match="was begun with world"):
        climb(output=tmp_path / "ladder", config=replace(config, world="nominal"))
