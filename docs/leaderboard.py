"""Write the tables of docs/evidence/leaderboard.md from the files in submissions/: `python docs/leaderboard.py`."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

import yaml

from endopilot.ladder.scores import score_navigations
from endopilot.ladder.submission import Submission, read_submission
from endopilot.tasks.task import list_tasks

PAGE = Path(__file__).parent / "evidence" / "leaderboard.md"
FOLDER = PAGE.parents[2] / "submissions"
LINKS_FILE = "links.yaml"
TITLES = {2: "Version 2", "coaxial": "Wire and catheter", 1: "Version 1"}
HEAD = ("policy", "tasks", "navigations", "safe success, %", "95 % interval", "exposures", "peak force, N", "time, s")


def page() -> str:
    """Return the page as it is to be: the tables between its markers are made of the submissions."""
    text, begin, end = PAGE.read_text(encoding="utf-8"), "<!-- scores:begin -->", "<!-- scores:end -->"
    head, rest = text.split(begin)
    return f"{head}{begin}\n" + "\n".join(_tables()) + f"\n{end}{rest.split(end)[1]}"


def _tables() -> Iterator[str]:
    links = yaml.safe_load((FOLDER / LINKS_FILE).read_text(encoding="utf-8"))
    read = {path: read_submission(path) for path in sorted(FOLDER.glob("*.json"))}
    for version, title in TITLES.items():
        rows = [_row(path, each, links[path.stem]) for path, each in read.items() if each.version == version]
        if rows:
            yield from (f"### {title}", "", _line(*HEAD, "made with"), "|" + "---|" * (len(HEAD) + 1))
            yield from (row for _, row in sorted(rows, reverse=True))
            yield ""


def _row(path: Path, submission: Submission, link: str) -> tuple[tuple[int, float, int], str]:
    """Return what a submission is ranked by, and its row: most tasks first, and of those the highest safe success."""
    done = [asdict(entry) for entries in submission.navigations.values() for entry in entries]
    scores = score_navigations([{key: value for key, value in each.items() if value is not None} for each in done])
    safe, count, tasks = scores["safe_success"], len(done), len(submission.tasks)
    low, high = interval(round(safe * count), count)
    named = f"{tasks} of {len(list_tasks(submission.version))}" if tasks > 2 else ", ".join(submission.tasks)
    made = f"{submission.versions.get('endopilot')}, {submission.core}"
    cells = (
        f"[{submission.policy}]({link})",
        named,
        f"[{count}](../../submissions/{path.name})",
        f"{100 * safe:.0f}",
        f"{100 * low:.0f}–{100 * high:.0f}",
        scores["exposures"],
        scores["peak_force_n"],
        "–" if scores["seconds"] is None else scores["seconds"],
        made,
    )
    return (tasks, safe, count), _line(*cells)


def _line(*cells: object) -> str:
    return "| " + " | ".join(map(str, cells)) + " |"


def interval(reached: int, count: int) -> tuple[float, float]:
    """Return Wilson's 95 % interval of a share (J. Am. Stat. Assoc. 22, 209, 1927)."""
    z, share = 1.959964, reached / count
    middle, width = share + z * z / (2 * count), z * ((share * (1 - share) + z * z / (4 * count)) / count) ** 0.5
    return tuple(max(0.0, (middle + sign * width) / (1 + z * z / count)) for sign in (-1, 1))


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
