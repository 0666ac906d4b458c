"""Drive all files of submissions/ again, and write the tables of docs/evidence/leaderboard.md.

`python docs/leaderboard.py` leaves with exit code 1, and the page as it was, if a file is not confirmed. With `--climb`
the shipped policies climb again first, as many tasks and patients as their files have: a change of theirs asks for it.
Files with the first of `KERNELS` can be judged on most machines.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import yaml

from endopilot.files import json_text
from endopilot.ladder.ladder import LadderConfig, climb
from endopilot.ladder.scores import score_navigations
from endopilot.ladder.submission import SUBMISSION_FILE, Submission, check_submission, read_submission
from endopilot.ladder.table import TITLES, terms_in_words
from endopilot.ladder.terms import Terms
from endopilot.navigation.policies import POLICIES
from endopilot.tasks.task import list_tasks

PAGE = Path(__file__).parent / "evidence" / "leaderboard.md"
FOLDER = PAGE.parents[2] / "submissions"
BY_US = FOLDER / "run_by_us"
"""Of files that the workflow made with `--drawn`. Beside them lie the files of their policies, if these are no shipped
ones: the check lets them decide again, in a process of their own that is handed observations alone."""
EXAMPLES = FOLDER.parent / "examples"
"""Where policies of other files may be at hand."""
LINKS_FILE = "links.yaml"
HEAD = ("policy", "mark", "tasks", "navigations", "safe success, %", "95 % interval", "exposures", "peak force, N")
HEAD += ("time, s", "kernel")


def files() -> list[Path]:
    """Return the files of all submissions."""
    return sorted([*FOLDER.glob("*.json"), *BY_US.glob("*.json")])


def mark(path: Path, submission: Submission) -> str:
    """Return what a confirmed file may be called."""
    at_hand = submission.policy in POLICIES.shipped or policy_file(submission, EXAMPLES)
    return "run by us" if path.parent == BY_US else "decided again" if at_hand else "replayed"


def policy_file(submission: Submission, folder: Path) -> str:
    """Return FILE:OBJECT of a policy that is no shipped one, where a folder holds its file; else nothing."""
    module, _, thing = submission.policy.partition(":")
    file = folder / f"{module}.py"
    return f"{file}:{thing}" if thing and file.exists() else ""


def checked(path: Path, by_us: Path = BY_US) -> tuple[bool, str]:
    """Drive a file again; return whether it may have its mark, and what came of it."""
    submission = read_submission(path)
    file = policy_file(submission, by_us if path.parent == by_us else EXAMPLES)
    policy = LadderConfig(policy=file).policy if file else ""
    found = check_submission(path, policy=policy)
    remarks = "; ".join(filter(None, [found.difference, *found.remarks]))
    if path.parent == by_us and (submission.drawn is None or found.verdict != "decided again"):
        return False, f"not run by us: drawn {submission.drawn}, {found.verdict}; {remarks}"
    return found.confirmed, f"{found.verdict}; {remarks}"


def page() -> str:
    """Return the page as it is to be, if all files are confirmed: the tables between its markers are made of them."""
    text, begin, end = PAGE.read_text(encoding="utf-8"), "<!-- scores:begin -->", "<!-- scores:end -->"
    head, rest = text.split(begin)
    return f"{head}{begin}\n" + "\n".join(_tables()) + f"\n{end}{rest.split(end)[1]}"


def _tables() -> Iterator[str]:
    """Return a table for each key, those of the shipped versions on usual terms first, with most tasks."""
    links = yaml.safe_load((FOLDER / LINKS_FILE).read_text(encoding="utf-8"))
    tables: dict[str, list] = {}
    for path in files():
        submission = read_submission(path)
        row = _row(path, submission, links[path.stem])
        tables.setdefault(json_text(submission.key), []).append((submission.key, row))
    for rows in sorted(tables.values(), key=lambda rows: _place(rows[0][0])):
        key = rows[0][0]
        drawn = " drawn for the test" * (key["split"] == "test")
        some = f", {len(key['done'])} tasks" * (len(key["done"]) < len(list_tasks(key["ladder"])))
        title = f"{TITLES.get(key['ladder'], key['ladder'])}, {max(key['done'].values())} patients"
        yield from (f"### {title}{drawn}{some}", "", f"Key: {terms_in_words(key)}.", "")
        yield from (_line(*HEAD), "|" + "---|" * len(HEAD))
        yield from (line for _, line in sorted((row for _, row in rows), reverse=True))
        yield ""


def _place(key: Mapping[str, Any]) -> tuple:
    known, usual = list(TITLES), Terms(key["ladder"]).key()
    unusual = sum(key[name] != usual[name] for name in usual)
    return known.index(key["ladder"]) if key["ladder"] in known else len(known), unusual, -len(key["done"])


def _row(path: Path, submission: Submission, link: str) -> tuple[tuple[int, float, int], str]:
    """Return what a submission is ranked by, and its row: most tasks first, and of those the highest safe success."""
    done = [asdict(entry) for entries in submission.navigations.values() for entry in entries]
    scores = score_navigations([{key: value for key, value in each.items() if value is not None} for each in done])
    safe, count, tasks = scores["safe_success"], len(done), len(submission.tasks)
    low, high = scores["safe_from"], scores["safe_to"]
    called = mark(path, submission)
    cells = (
        f"[{submission.policy}]({link})",
        called,
        f"{tasks} of {len(list_tasks(submission.ladder))}" if tasks > 2 else ", ".join(submission.tasks),
        f"[{count}](../../{path.relative_to(FOLDER.parent)})",
        f"{100 * safe:.0f}",
        f"{100 * low:.0f}–{100 * high:.0f}",
        "–" if called == "replayed" else scores["exposures"],
        scores["peak_force_n"],
        "–" if scores["seconds"] is None else scores["seconds"],
        (submission.blas or "").partition(" ")[2],
    )
    return (tasks, safe, count), _line(*cells)


def _line(*cells: object) -> str:
    return "| " + " | ".join(map(str, cells)) + " |"


def climb_again(path: Path) -> None:
    """Make the file of a shipped policy again."""
    was = read_submission(path)
    patients = max(map(len, was.navigations.values()))
    given = {"policy": was.policy, "tasks": tuple(was.tasks), "version": was.ladder, "thinking_s": was.thinking_s}
    config = LadderConfig(patients=patients, **given)
    with tempfile.TemporaryDirectory() as folder:
        climb(output=folder, config=config)
        path.write_bytes((Path(folder) / SUBMISSION_FILE).read_bytes())


def main() -> None:
    """Check all files, and write the page."""
    bad = 0
    for path in files():
        if "--climb" in sys.argv and path.parent == FOLDER and read_submission(path).policy in POLICIES.shipped:
            climb_again(path)
        passed, said = checked(path)
        print(f"{path.name}: {said}")
        bad += not passed
    if bad:
        sys.exit(f"{bad} of {len(files())} files are not confirmed; {PAGE.name} stays as it was")
    PAGE.write_text(page(), encoding="utf-8")


if __name__ == "__main__":
    main()
