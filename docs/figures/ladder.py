"""Write tasks and scores into docs/evidence/ladder.md: `python docs/figures/ladder.py [FOLDER [STEVE]]`.

FOLDER, runs/ladder if not given, holds what `endopilot ladder` made of each policy in the newest version and, with
`--version coaxial`, of those that drive a catheter. STEVE, runs/steve if not given, holds what it made of the tasks of
a public benchmark, a folder for each; what it tells of DualDeviceNav's arteries is read where its tasks lie. A folder
that is not there leaves its table as it is.
"""

from __future__ import annotations

import json
import sys
from collections import defaultdict
from operator import itemgetter
from pathlib import Path
from statistics import median

sys.path.append(str(Path(__file__).parents[2]))  # where `benchmarks` is

from benchmarks.figures import DOCS, fill, markdown_table
from endopilot.tasks.task import NEWEST, LadderVersion, find_task, list_tasks

ROOT = Path(__file__).parents[2]
PAGE = "evidence/ladder.md"
_MEANS = (("peak force, median, N", "peak_force_n"), ("exposures, mean", "exposures"))
_MISSED = "events missed, %"
_PUBLISHED = (
    ("archvariety", "learned, best", "theirs", "97", "all frames, some 250", "–", "none", "100"),
    ("dualdevicenav", "learned, best", "theirs", "40", "all frames", "–", "none", "100"),
)
"""Success of the controllers that were trained for the benchmark (Karstensen et al., arXiv 2410.01956)."""
_ARTERIES = {
    "G4.3": "left common carotid",
    "G4.4": "left vertebral",
    "G6.2": "right carotid",
    "G7.2": "right vertebral",
}
"""Sections of DualDeviceNav's tree in which its targets lie."""


def tasks() -> list[str]:
    """Return the table of the tasks."""
    head, rows = ("level", "task", "what", "atlas", "wire, tip", "time, s", "patients"), []
    for task in list_tasks():
        tip = f"{task.device}, {task.tip_bend_deg:g}° over {task.tip_bend_mm:g} mm"
        what = f"{task.title}: {task.depth_mm:g} mm into {task.section}"
        rows.append((task.level, task.name, what, task.vessel, tip, f"{task.seconds:g}", task.chosen_for))
    return markdown_table(head, rows)


def coaxial_tasks() -> list[str]:
    """Return the table of the tasks of wire and catheter."""
    head, rows = ("level", "task", "what", "atlas", "wire, catheter", "time, s", "limit, N", "patients"), []
    for task in list_tasks("coaxial"):
        tip = f"{task.device}, {task.tip_bend_deg:g}° over {task.tip_bend_mm:g} mm; {task.catheter}"
        what = f"{task.title}: {task.depth_mm:g} mm into {task.section}"
        numbers = (f"{task.seconds:g}", task.force_limit_n)
        rows.append((task.level, task.name, what, task.vessel, tip, *numbers, task.chosen_for))
    return markdown_table(head, rows)


def scores(folder: Path, version: LadderVersion, mark: str) -> list[str]:
    """Return one table of the policies' scores in a version: safe success, and in brackets success, %.

    A policy that is not in the folder keeps its column as the page has it between its marks.
    """
    columns = _kept(mark)
    for path in sorted(folder.glob("*/ladder.json")):
        content = json.loads(path.read_text(encoding="utf-8"))
        if content["ladder"] != version:
            continue
        table = {row["task"]: row for row in content["scores"]}
        column = {name: f"{100 * row['safe_success']:.0f} ({100 * row['success']:.0f})" for name, row in table.items()}
        if (over := table.get("all twelve") or table.get("upper eight") or table.get("all coaxial")) is not None:
            column |= {title: f"{over[key]:.3g}" for title, key in _MEANS}
            column |= {_MISSED: f"{100 * over['missed_events']:.1f}"} if "missed_events" in over else {}
        columns[path.parent.name] = column | {"patients a task": str(content["patients"])}
    sums = ["all coaxial"] if version == "coaxial" else ["lower four", "upper eight", "all twelve"]
    names = [task.name for task in list_tasks(version)] + sums
    names += [*(title for title, _ in _MEANS), _MISSED, "patients a task"]
    policies = sorted(columns)
    rows = [(name, *(columns[policy].get(name, "–") for policy in policies)) for name in names]
    return markdown_table(("task", *policies), (row for row in rows if set(row[1:]) != {"–"}))


def _kept(mark: str) -> dict[str, dict[str, str]]:
    """Return the columns that stand in the page between marks of some name."""
    rows = _rows(mark)
    if not rows:
        return {}
    head, body = rows[0][1:], rows[1:]
    return {policy: {row[0]: row[1 + place] for row in body} for place, policy in enumerate(head)}


def _rows(mark: str) -> list[tuple[str, ...]]:
    """Return the rows of the table that stands in the page between marks of some name, its head first."""
    text = (DOCS / PAGE).read_text(encoding="utf-8").split(f"<!-- {mark}:begin -->")[1].split(f"<!-- {mark}:end -->")[0]
    rows = [tuple(cell.strip() for cell in line.strip("|").split("|")) for line in text.splitlines() if line[:1] == "|"]
    return [row for row in rows if set(row[0]) != {"-"}]


def benchmark(folder: Path) -> list[str]:
    """Return the table of a public benchmark's tasks: what its paper reports, and what each run in a folder reached.

    What is not in the folder keeps its row as the page has it.
    """
    head = ("task", "controller", "world", "within 5 mm, %", "exposures", "force, N", "planning, s", "episodes")
    rows = {row[:3]: row for row in [*_PUBLISHED, *_rows("benchmark")[1:]]}
    for path in sorted(folder.glob("*/ladder.json")):
        content = json.loads(path.read_text(encoding="utf-8"))
        (row,) = content["scores"]
        done = [json.loads(each.read_text(encoding="utf-8")) for each in sorted((path.parent / row["task"]).glob("*"))]
        planning = [each["planning_s"] for each in done]
        cells = (row["task"], f"`{content['policy']}`", content["world"]["name"].rpartition("/")[2])
        cells += (f"{100 * row['near']:.0f}", f"{row['exposures']:g}", f"{row['peak_force_n']:.3g}")
        cells += (f"{row['planning_s']:.0f}, at most {max(planning):.0f}", str(len(done)))
        rows[cells[:3]] = cells
    return markdown_table(head, rows.values())


def arteries(results: Path, version: LadderVersion) -> list[str]:
    """Return the table of DualDeviceNav's arteries: how deep their targets lie, what was reached, and medians.

    Args:
        results: folder of the navigations' results.
        version: folder of the tasks.
    """
    task, found = find_task("dualdevicenav", version=version), defaultdict(list)
    for path in sorted(results.glob("*.json")):
        navigation = task.ladder_navigation(int(path.stem))
        tree, target = navigation.anatomy.tree, navigation.target
        section = tree.section_names[tree.branches[target.branch].section[-1]]
        found[_ARTERIES[section]].append((target.abscissa, json.loads(path.read_text(encoding="utf-8"))))
    rows = []
    for artery, done in sorted(found.items()):
        depths, scored = zip(*sorted(done, key=itemgetter(0)), strict=True)
        reached = [f"{sum(each[rule] for each in scored)} of {len(scored)}" for rule in ("near", "success")]
        medians = [f"{median(each[name] for each in scored):.0f}" for name in ("seconds", "exposures", "planning_s")]
        rows.append((artery, ", ".join(f"{depth:.0f}" for depth in depths), *reached, *medians))
    head = ("artery", "targets, mm", "within 5 mm", "by both rules", "time, s", "exposures", "planning, s")
    return markdown_table(head, rows)


def main() -> None:
    """Fill the page."""
    given = [Path(argument) for argument in sys.argv[1:]]
    ladder, steve = [*given, *[ROOT / "runs" / name for name in ("ladder", "steve")][len(given) :]]
    fill(PAGE, "tasks", tasks(), dated=False)
    fill(PAGE, "coaxial tasks", coaxial_tasks(), dated=False)
    driven = {json.loads(path.read_text(encoding="utf-8"))["ladder"] for path in ladder.glob("*/ladder.json")}
    for version, mark in ((NEWEST, "scores"), ("coaxial", "coaxial scores")):
        if version in driven:
            fill(PAGE, mark, scores(ladder, version, mark))
    if steve.is_dir():
        fill(PAGE, "benchmark", benchmark(steve))
    for results in sorted(steve.glob("*/dualdevicenav")):
        version = json.loads((results.parent / "ladder.json").read_text(encoding="utf-8"))["ladder"]
        if Path(version).is_dir():
            fill(PAGE, "arteries", arteries(results, version))


if __name__ == "__main__":
    main()
