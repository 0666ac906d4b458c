"""`--drawn`: a policy that is handed observations alone, in patients that the hash of the request draws."""

from __future__ import annotations

import json
import runpy
import shutil
import sys
from pathlib import Path

import pytest

from endopilot.errors import InputError
from endopilot.ladder.attempt import Apart, attempt, navigation_seed
from endopilot.ladder.ladder import LadderConfig, climb, terms_of
from endopilot.ladder.submission import check_submission
from endopilot.ladder.terms import Terms
from endopilot.navigation.policy import Observation
from endopilot.tasks.task import find_task

LEADERBOARD = Path(__file__).parents[2] / "docs" / "leaderboard.py"
_POLICY = """
import gc
from endopilot.navigation.policy import Decision

class Spy:
    def start(self, navigation, seed):
        self.seed = seed
    def decide(self, observation):
        found = [each for each in gc.get_objects() if type(each).__name__ == "Simulator"]
        return Decision(((6.0, 0.1),), expose=observation.time_s % 1.5 == 0.5, gives_up="a world" if found else "")

class Telling(Spy):
    def decide(self, observation):
        return Decision(((self.seed, 0.0),))

class Garbled(Spy):
    def decide(self, observation):
        return Decision((("fast", 1),))

class Dying(Spy):
    def decide(self, observation):
        import os
        os._exit(0)

class Raising(Spy):
    def decide(self, observation):
        raise ZeroDivisionError("oh")
"""


_SEEN = Observation(0.0, ((5.0, 0.0),), None)


@pytest.fixture
def spies(tmp_path, monkeypatch):
    """Return the path of a file of policies."""
    (tmp_path / "of_mine").mkdir()
    file = tmp_path / "of_mine" / "spies.py"
    file.write_text(_POLICY)
    monkeypatch.setattr(sys, "path", [*sys.path])
    yield file
    sys.modules.pop("spies", None)


def test_a_policy_from_a_file_is_run_in_patients_that_its_request_draws(spies, tmp_path):
    config = LadderConfig(policy=f"{spies}:Spy", tasks=("straight",), patients=1, drawn="commit 1f3a")
    (row,) = climb(output=tmp_path / "run", config=config)
    assert row["exposures"] > 2 and row["safe_success"] == 1.0
    content = json.loads((tmp_path / "run" / "submission.json").read_text(encoding="utf-8"))
    done, usual = content["navigations"]["straight"], find_task("straight").ladder
    drawn = terms_of(config).task("straight").ladder
    assert [entry["reason"] for entry in done] == ["reached"]  # it saw no world
    assert [entry["seed"] for entry in done] == [drawn.seed] and drawn.seed != usual.seed
    found = check_submission(tmp_path / "run" / "submission.json")
    assert found.verdict == "replayed" and found.key["split"] == "test" and found.key != Terms().key()
    checked = runpy.run_path(str(LEADERBOARD))["checked"]
    by_us = shutil.copy(tmp_path / "run" / "submission.json", spies.parent)
    assert checked(Path(by_us), spies.parent) == (True, "decided again; ")  # by the file that lies beside it
    spies.write_text(_POLICY.replace("6.0, 0.1", "6.0, 0.2"))
    assert checked(Path(by_us), spies.parent)[1].startswith("not run by us: drawn commit 1f3a, failed; task straight")
    Path(by_us).write_text(json.dumps(content | {"policy": "unknown"}), encoding="utf-8")
    with pytest.raises(InputError, match="task straight, patient 0: seed"):  # whoever is asked for draws the patients
        checked(Path(by_us), spies.parent)
    for change in ({"drawn": "commit 2"}, {"drawn": None}):
        (tmp_path / "changed.json").write_text(json.dumps(content | change), encoding="utf-8")
        with pytest.raises(InputError, match="task straight, patient 0: seed"):
            check_submission(tmp_path / "changed.json")


def test_every_part_of_a_request_draws_other_patients():
    drawn = Terms().drawn("p", "p.py", "word", 1)
    requests = {
        terms.request
        for terms in (
            drawn,
            Terms().drawn("q", "p.py", "word", 1),
            Terms().drawn("p", "q.py", "word", 1),
            Terms().drawn("p", "p.py", "other", 1),
            Terms("coaxial").drawn("p", "p.py", "word", 1),
        )
    }
    assert len(requests) == 5 and Terms().drawn("p", "p.py", "word", 1) == drawn
    names = ("straight", "descending")
    assert len({navigation_seed(drawn.task(name), 0) for name in names} | {100, 200}) == 4
    assert drawn.task("crux").target  # a patient in which it exists


def test_the_world_is_in_another_process_whose_seed_is_not_told(spies):
    sys.path.insert(0, str(spies.parent))
    terms = Terms().drawn("spies:Spy", "", "", 1)
    task = terms.task("straight")
    result = attempt("spies:Spy", task.ladder_navigation(0), seed=5, terms=terms)
    here = attempt("spies:Spy", task.ladder_navigation(0), seed=5)
    assert (result["reason"], here["reason"]) == ("reached", "gave up")  # in this process it finds the simulated world
    with Apart("spies:Telling") as policy:
        policy.start(task.ladder_navigation(0), 5)
        assert policy.decide(_SEEN).devices[0][0] != 5


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("Garbled", "policy: 'spies:Garbled' decided no velocities"),
        ("Dying", "policy: the process of 'spies:Dying' has ended"),
        ("Raising", "policy: 'spies:Raising': decide failed .ZeroDivisionError: oh, spies.py line"),
    ],
)
def test_what_is_no_decision_names_the_policy(spies, name, said):
    sys.path.insert(0, str(spies.parent))
    navigation = find_task("straight").ladder_navigation(0)
    with Apart(f"spies:{name}") as policy:
        policy.start(navigation, 1)
        with pytest.raises(InputError, match=said):
            policy.decide(_SEEN)
