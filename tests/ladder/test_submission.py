"""A submission's scores are confirmed by its recordings; what was changed in the file is refused or named."""

from __future__ import annotations

import hashlib
import json
import runpy
import sys
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from command import output_of, run
from endopilot.devices.device import read_wire
from endopilot.errors import InputError
from endopilot.files import json_text, read_json
from endopilot.ladder import submission
from endopilot.ladder.attempt import Recording, attempt, begun, repeat, scored
from endopilot.ladder.ladder import LadderConfig, climb, terms_of
from endopilot.ladder.scores import score, submitted
from endopilot.ladder.submission import check_submission, key_of
from endopilot.ladder.terms import Terms, task_digest
from endopilot.simulation.world import World
from endopilot.tasks.task import find_task, list_tasks

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


def _climbed(folder: Path, **settings) -> dict:
    climb(output=folder, config=LadderConfig(patients=1, **settings))
    return read_json(folder / "submission.json")


@pytest.fixture(scope="module")
def written(tmp_path_factory) -> dict:
    """Return the content of the submission of `forward` in the first patient of a task."""
    return _climbed(tmp_path_factory.mktemp("submission"), policy="forward", tasks=("straight",))


@pytest.fixture
def check(tmp_path):
    """Return a function that writes a changed copy of a submission and checks it."""

    def check(written: dict, change=lambda _: None) -> submission.SubmissionCheck:
        content = json.loads(json.dumps(written))
        change(content)
        path = tmp_path / "submission.json"
        path.write_text(json.dumps(content), encoding="utf-8")
        return check_submission(path)

    return check


@pytest.fixture
def changed(written, check):
    """Return a function that checks a changed copy of the submission."""
    return lambda change: check(written, change)


def _first(content: dict) -> dict:
    return content["navigations"]["straight"][0]


def _record(content: dict, change) -> None:
    """Change the first navigation's recording."""
    entry = _first(content)
    recording = Recording.unpacked(entry["recording"])
    control, exposed = recording.control.copy(), recording.exposed.copy()
    control, exposed = change(control, exposed)
    entry["recording"] = Recording(control, exposed, None).packed()


def _too_fast(content: dict) -> dict:
    """Return a navigation whose drive is commanded more than it does, with the hash of that."""
    was, navigation = Recording.unpacked(_first(content)["recording"]), find_task("straight").ladder_navigation(0)
    fast = was.control * np.where(np.arange(len(was.control)) == 2, 100.0, 1.0)[:, None, None]
    record = begun(replace(was, control=fast), navigation, seed=100).run()
    fast = np.vstack([fast, np.zeros_like(fast)])[: len(record.control)]
    forged = scored(navigation, replace(record, control=fast))
    return {name: value for name, value in forged.items() if name != "course"}


def test_a_submission_is_confirmed(written, check):
    found = check(written)
    assert (found.verdict, found.difference, found.navigations, found.remarks) == ("decided again", None, 1, ())
    assert [submitted(row) for row in found.scores] == written["scores"]  # as they were driven again
    assert found.policy == "forward" and found.origin.startswith("endopilot ")
    assert [row["task"] for row in written["scores"]] == ["straight"]


def test_a_file_of_version_1_is_driven_again_in_the_textbook_s_patients(tmp_path):
    content, path = _climbed(tmp_path, policy="forward", tasks=("straight",), version=1), tmp_path / "submission.json"
    assert check_submission(path).difference is None
    path.write_text(json.dumps(content | {"ladder": 2}), encoding="utf-8")
    with pytest.raises(InputError, match="task 'straight' of ladder 2 is not the one here"):
        check_submission(path)


def test_a_version_1_task_has_the_hash_of_its_file_before_there_were_versions():
    since = ("version", "catheter", "arrives", "start_catheter_mm", "anatomies", "targets_mm", "near_mm")
    task = find_task("crux", version=1)
    then = {"vessel": "anatomy", "start_inserted_length_mm": "start_inserted_mm"}
    before = {then.get(name, name): value for name, value in asdict(task).items() if name not in since}
    content = json_text(before) + json_text(read_wire(task.device))
    assert task_digest(task) == hashlib.sha256(content.encode()).hexdigest()
    assert task_digest(task) != task_digest(replace(task, version=2))


@pytest.mark.parametrize(
    ("change", "difference"),
    [
        (lambda c: _first(c).update(peak_force_n=0.0123), "peak_force_n is 0.0123 in the file and 0."),
        (lambda c: _first(c).update(patient="nobody"), 'patient is "nobody" in the file'),
        (lambda c: _first(c).update(sha256="0" * 64), "decisions or course are not those"),
        (lambda c: _record(c, lambda v, x: (v * (1 + 1e-12), x)), ""),
        (lambda c: _record(c, lambda v, x: (v, x | (np.arange(len(x)) == 3))), "exposures is 1 in the file and 2"),
        (lambda c: _record(c, lambda v, x: (v[:-1], x[:-1])), "decisions, and the navigation goes on"),
        (lambda c: _record(c, lambda v, x: (np.vstack([v, v]), np.hstack([x, x]))), "and the navigation ends after"),
        (lambda c: _record(c, lambda v, x: (v, ~x)), "X-ray is off at the first decision"),
        (lambda c: _first(c).update(_too_fast(c)), "control: decision 2 is beyond the drives' limits"),
        (lambda c: _first(c)["recording"].update(control="AAAA"), "control: no recorded array"),
    ],
)
def test_a_changed_navigation_is_named(changed, change, difference):
    found = changed(change).difference
    assert found.startswith("task straight, patient 0: ") and difference in found
    assert found.endswith("(1 of 1 navigations differ)")


def test_the_first_of_several_navigations_is_named_by_level(looking, check):
    def both(content):
        content["navigations"] = dict(reversed(content["navigations"].items()))
        for done in content["navigations"].values():
            done[0]["seconds"] += 0.5

    found = check(looking, both).difference
    assert found.startswith("task straight, patient 0: seconds is") and found.endswith("(2 of 2 navigations differ)")


def test_a_changed_score_is_named(changed):
    found = changed(lambda c: c["scores"][0].update(safe_success=0.5)).difference
    assert "scores, straight: safe_success is " in found
    more = {"level": None, "task": "all twelve", "safe_success": 1.0}
    assert "scores, all twelve: level is null" in changed(lambda c: c["scores"].append(more)).difference


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: _first(c).update(seed=101), "task straight, patient 0: seed 101; the ladder's is 100"),
        (lambda c: c["tasks"].update(straight="0" * 64), "task 'straight' of ladder 2 is not the one here"),
        (lambda c: c["tasks"].pop("straight"), "tasks and navigations name different tasks"),
        (
            lambda c: [of.update(moon=of.pop("straight")) for of in (c["tasks"], c["navigations"])],
            "task: 'moon'; choose",
        ),
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


def _again(content: dict, change) -> None:
    """Change the recording of the first navigation, and make all figures and scores follow from it."""
    task, entry = find_task("straight"), _first(content)
    navigation, was = task.ladder_navigation(0), Recording.unpacked(entry["recording"])
    recording = change(was)
    entry |= repeat(recording, navigation, seed=entry["seed"]) | {"recording": recording.packed()}
    _score(content)


def _score(content: dict) -> None:
    results = {
        name: [{key: value for key, value in one.items() if value is not None} for one in done]
        for name, done in content["navigations"].items()
    }
    content["scores"] = [submitted(row) for row in score([t for t in list_tasks() if t.name in results], results)]


def _on_terms(content: dict, **changed) -> None:
    """Say that all was done on other terms."""
    content["key"] = key_of(Terms(**changed), content["key"]["done"])
    content |= json.loads(json_text(changed))


def _made_up(content: dict) -> None:
    content["versions"]["endopilot"], content["core"] = "0.0.1", "another"
    _first(content).update(seconds=0.5, exposures=0, peak_force_n=1e-6)
    _score(content)


def _of_blas(content: dict, blas: str) -> None:
    content["blas"] = blas
    _first(content)["peak_force_n"] *= 0.95
    _score(content)


def _without_exposures(content: dict) -> None:
    _again(content, lambda was: replace(was, exposed=np.arange(len(was.exposed)) == 0))


def _of_a_better_hand(content: dict) -> None:
    _again(content, lambda was: replace(was, control=was.control * [1.0 + 1e-9, 1.0]))


def _left_out(content: dict) -> None:
    for of in (content["tasks"], content["navigations"]):
        del of["descending"]
    _score(content)


def _twice(content: dict) -> None:
    content["key"]["done"] = dict.fromkeys(sorted(content["tasks"]), 2)
    for done in content["navigations"].values():
        done.append(done[0] | {"seed": done[0]["seed"] + 1})
    _score(content)


def _in_another_patient(content: dict) -> None:
    _first(content).update({k: v for k, v in content["navigations"]["descending"][0].items() if k != "seed"})
    _score(content)


@pytest.fixture(scope="module")
def looking(tmp_path_factory) -> dict:
    """Return the content of the submission of `retract-rotate`, which looks at every decision."""
    return _climbed(tmp_path_factory.mktemp("looking"), policy="retract-rotate", tasks=("straight", "descending"))


@pytest.mark.parametrize(
    ("forge", "said"),
    [
        (_made_up, "seconds is 0.5 in the file and "),
        (
            lambda c: _of_blas(c, "mkl"),
            "blas: mkl; submissions are driven again with openblas Haswell, numpy X86_V3 or with openblas Ha",
        ),
        (lambda c: _of_blas(c, next(each for each in submission.KERNELS if each != submission.kernels())), None),
        (_without_exposures, "retract-rotate decides otherwise"),
        (_of_a_better_hand, "retract-rotate decides otherwise"),
        (_in_another_patient, "task straight, patient 0: "),
        (_left_out, "key.done: "),
        (lambda c: c["navigations"]["straight"].append(_first(c)), "needs the same first 1 to 20 patients"),
        (_twice, "task straight, patient 1: patient is "),
        (lambda c: c.update(world=asdict(World(friction_factor=0.2))), "key.world: {}; from all else follows {"),
        (lambda c: _on_terms(c, world=World(friction_factor=0.2)), "in the file and"),
        (lambda c: _on_terms(c, thinking_s=0.5), "decisions, and the navigation goes on"),
        (lambda c: c.update(drawn="mine"), "straight, patient 0: seed 100; the ladder's is"),
        (lambda c: c["key"].update(settings="0" * 64), "key.settings: "),
        (lambda c: c["key"].update(decision_period_s=0.1), "key.decision_period_s: 0.1; from all else follows 0.5"),
    ],
)
def test_a_forgery_is_never_confirmed(looking, check, forge, said):
    try:
        found = check(looking, forge)
    except InputError as error:
        assert said in str(error)
    else:
        assert not found.confirmed and not found.scores and (said or "") in (found.difference or "")
        assert found.verdict == "failed" or (said is None and "does not run" in found.remarks[0])


def test_exposures_that_nobody_decided_again_are_not_confirmed(looking, check):
    def forge(content):
        _without_exposures(content)
        content["policy"] = "of-mine"

    found = check(looking, forge)
    assert found.verdict == "replayed"
    assert "exposures" not in found.scores[0] and found.remarks[-1].startswith("exposures are not counted")


def test_the_folder_alone_makes_nothing_run_by_us(written, tmp_path):
    path = tmp_path / "submission.json"
    path.write_text(json.dumps(written), encoding="utf-8")
    leaderboard = runpy.run_path(str(Path(__file__).parents[2] / "docs" / "leaderboard.py"))
    assert leaderboard["checked"](path, tmp_path) == (False, "not run by us: drawn None, decided again; ")


def test_thinking_is_charged_told_and_a_term_of_its_own(tmp_path):
    (tmp_path / "world.yaml").write_text("robot: {latency_s: 0.2}\n", encoding="utf-8")
    config = LadderConfig(policy="forward", tasks=("straight",), patients=1, world=str(tmp_path / "world.yaml"))
    at_once = attempt("forward", find_task("straight").ladder_navigation(0), seed=100, terms=terms_of(config))
    climb(output=tmp_path / "run", config=replace(config, thinking_s=0.5))
    found = check_submission(tmp_path / "run" / "submission.json")
    assert found.verdict == "decided again" and found.key["thinking_s"] == 0.5
    assert found.decision_ms is not None and found.scores[0]["seconds"] == at_once["seconds"] + 0.5
    assert Terms(thinking_s=0.5).loop.robot.latency_s == pytest.approx(0.55)  # as `NavigationLoop` tells policies


def test_a_kernel_that_this_machine_lacks_is_not_judged(looking, check, monkeypatch):
    monkeypatch.setitem(submission.KERNELS, "openblas Loongson, numpy X86_V3", ("avx1024", {}))
    found = check(looking | {"blas": "openblas Loongson, numpy X86_V3"})
    assert (found.verdict, found.confirmed, found.scores) == ("not judged", False, ())
    said = "this machine does not run openblas Loongson, numpy X86_V3: nothing was driven again"
    assert found.remarks == (said,)


def test_other_versions_are_stated_and_buy_nothing(changed):
    def older(content):
        content["versions"] |= {"endopilot": "0.0.1", "numpy": "1.0"}
        content["core"] = "another"

    found = changed(older)
    assert found.confirmed and [remark.split(",")[0] for remark in found.remarks] == [
        "made with endopilot 0.0.1", "made with numpy 1.0", "made with core another",
    ]  # fmt: skip


def test_a_policy_of_one_s_own_climbs_and_its_submission_is_confirmed(tmp_path, monkeypatch, capsys):
    (tmp_path / "hurried.py").write_text(_POLICY)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    words = ["ladder", "--policy", "hurried:Hurried", "--tasks", "straight", "--patients", "1", "--no-page"]
    file = tmp_path / "runs" / "ladder" / "hurried.Hurried" / "submission.json"
    assert str(file.relative_to(tmp_path)) in output_of(capsys, *words)
    content = json.loads(file.read_text(encoding="utf-8"))
    assert content["origin"].startswith("hurried.py sha256:") and _first(content)["exposures"] > 1
    assert check_submission(file, policy="hurried:Hurried").verdict == "decided again"
    forged = json.loads(json.dumps(content))
    _again(forged, lambda was: replace(was, exposed=np.arange(len(was.exposed)) == 0))
    (tmp_path / "forged.json").write_text(json.dumps(forged), encoding="utf-8")
    assert check_submission(tmp_path / "forged.json", policy="hurried:Hurried").verdict == "failed"
    Path("hurried.py").unlink()  # the check does not need the policy
    del sys.modules["hurried"]
    checked = run(capsys, "ladder", "--check", file)
    assert (checked["confirmed"], checked["verdict"]) == (True, "replayed")
    assert "exposures" not in checked["scores"][0]  # nobody can decide again
    _first(content)["seconds"] += 0.5
    file.write_text(json.dumps(content), encoding="utf-8")
    printed = json.loads(output_of(capsys, "ladder", "--check", file, "--json", code=1))
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


def test_a_ladder_in_another_world_is_confirmed_in_it(written, tmp_path):
    world = tmp_path / "world.yaml"
    world.write_text("lumen_factor: 1.1\nostium_mm: 1.0\nbacks_out_mm: 1.0\nbacks_out_after_s: 1.0\n", encoding="utf-8")
    given = {"policy": "forward", "tasks": ("straight",), "world": str(world)}
    content, path = _climbed(tmp_path / "ladder", **given), tmp_path / "ladder" / "submission.json"
    scores = read_json(path.with_name("ladder.json"))
    differs = {"lumen_factor": 1.1, "ostium_mm": 1.0, "backs_out_mm": 1.0, "backs_out_after_s": 1.0}
    assert scores["world"] == {"name": str(world)} | differs
    assert _first(content)["sha256"] != _first(written)["sha256"]
    found = check_submission(path)
    assert found.difference is None and found.key == scores["key"] | {"done": {"straight": 1}}
    assert found.key["world"] == differs != Terms().key()["world"]
    content["world"]["lumen_factor"] = content["key"]["world"]["lumen_factor"] = 1.05
    path.write_text(json.dumps(content), encoding="utf-8")
    assert check_submission(path).difference is not None
    with pytest.raises(InputError, match="was begun with world"):
        _climbed(path.parent, **given | {"world": "nominal"})
