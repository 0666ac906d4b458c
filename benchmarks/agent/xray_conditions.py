"""Drive the agent with images, in moving patients, and with both: `python -m benchmarks xray-conditions [PATIENTS]`.

PATIENTS of each coronary task of the ladder (2 if not given), with friction, tip stiffness, latency and ostium off by
20 %, up or down: with assumed errors of detection in a patient at rest; with X-ray images in a patient whose pose is
registered; in a patient whom heart and breath move by amplitudes of their own, of which the published mean is known;
with both; and with both where a run of contrast has measured the motion.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from benchmarks.figures import DOCS, fill
from endopilot.control.agent import AgentPolicy
from endopilot.errors import InputError
from endopilot.files import read_json, write_json
from endopilot.ladder.attempt import navigation_seed
from endopilot.ladder.terms import Terms
from endopilot.navigation.loop import LoopConfig, NavigationLoop, XrayKind
from endopilot.navigation.record import count_navigation_events
from endopilot.runs import claim, make_missing
from endopilot.settings import Count
from endopilot.simulation.motion import Motion, motion_named
from endopilot.simulation.world import World
from endopilot.tasks.task import CORE, NEWEST, find_task, list_tasks

FOLDER = Path("runs/xray-conditions")
Condition = Literal["assumed", "images", "moving", "together", "measured"]
CONDITIONS: dict[str, tuple[str, XrayKind, bool, bool]] = {
    "assumed": ("assumed errors, a patient at rest", "assumed", False, False),
    "images": ("images and registration", "images", False, False),
    "moving": ("heart and breath", "assumed", True, False),
    "together": ("all together", "images", True, False),
    "measured": ("all together, the motion measured by a run of contrast", "images", True, True),
}
"""By folder: the title, what an exposure is, whether heart and breath move it, and are measured."""
FRAMES_A_SECOND = 7.5
"""Of usual fluoroscopy in coronary arteries."""
MISMATCH = 0.2


def measure(path: Path) -> None:
    """Navigate in one patient under one condition, and write what came of it."""
    place, task = int(path.stem), find_task(path.parent.name)
    _, xray, moves, measured = CONDITIONS[path.parent.parent.name]
    navigation, seed = task.ladder_navigation(place), navigation_seed(task, place)
    config = LoopConfig(
        simulator=replace(CORE, threads=1),
        xray=xray,
        motion=motion_named("both", seed) if moves else None,
        measure_motion=measured,
    )
    navigation = replace(navigation, known_motion=Motion() if moves else None)
    try:
        record = NavigationLoop(navigation, AgentPolicy(), config=config, seed=seed, world=World(share=MISMATCH)).run()
    except InputError as error:  # the patient is not recognised in the images
        write_json(path, {"reason": str(error), "success": False, "safe": True})
        return
    assert record.believed is not None
    write_json(
        path,
        {
            "reason": record.gives_up or record.reason,
            "success": record.success,
            "safe": record.safe,
            "seconds": record.seconds,
            "exposures": record.exposures,
            "peak_force_n": record.peak_force_n,
            "events": {kind: list(each) for kind, each in count_navigation_events(record, navigation).items()},
            "decisions": [int(record.in_bands.sum()), len(record.in_bands)],
        },
    )


def row(name: str, results: list[dict[str, Any]]) -> str:
    """Return a condition's row of the table."""
    safe = sum(result["success"] and result["safe"] for result in results)
    driven = [result for result in results if "seconds" in result]
    seconds, exposures = (sum(result[part] for result in driven) for part in ("seconds", "exposures"))
    happened, missed, _ = np.sum([each for result in driven for each in result["events"].values()], axis=0).astype(int)
    contacts, unseen, evenly = np.sum([result["events"]["contact"] for result in driven], axis=0)
    held, decisions = np.sum([result["decisions"] for result in driven], axis=0)
    fewer = 1 - exposures / (FRAMES_A_SECOND * seconds)
    return (
        f"| {name} | {safe} of {len(results)} | {exposures / len(driven):.1f} | {60 * exposures / seconds:.0f} "
        f"| {exposures / len(driven) / FRAMES_A_SECOND:.1f} | {100 * fewer:.1f} % | {missed} of {happened} "
        f"| {unseen:.0f}; {evenly:.1f} of {contacts:.0f} | {100 * held / decisions:.0f} % |"
    )


def drive_under_conditions(
    patients: Count = 2, /, *, only: tuple[Condition, ...] = get_args(Condition), write: bool = False
) -> str:
    """Drive the agent with X-ray images, in moving patients, and with both, in the coronary tasks of the ladder.

    runs/xray-conditions gets one file a navigation; an interrupted run goes on with the others.

    Args:
        patients: of each task.
        only: conditions to drive under; the other rows of the table stay as they are.
        write: write the table into docs/evidence/advice.md.

    Returns:
        The table.

    Raises:
        InputError: the folder belongs to another run.
    """
    tasks = [task for task in list_tasks() if task.vessel in ("rca", "lca")]
    wanted = {
        name: [FOLDER / name / task.name / f"{place:02d}.json" for place in range(patients) for task in tasks]
        for name in only
    }
    claim(FOLDER, "python -m benchmarks xray-conditions", **Terms(NEWEST).identity("agent"))
    make_missing("The agent under X-ray", [path for paths in wanted.values() for path in paths], measure)
    before = (DOCS / "evidence/advice.md").read_text(encoding="utf-8").split("<!-- conditions:")[1]
    rows = {title: line for line in before.splitlines() for title, *_ in CONDITIONS.values() if f"| {title} |" in line}
    rows |= {
        CONDITIONS[name][0]: row(CONDITIONS[name][0], [read_json(path) for path in paths])
        for name, paths in wanted.items()
    }
    lines = [
        "| exposures and patient | reached safely | exposures a navigation | a minute | fluoroscopy, s "
        "| fewer frames than at 7.5 Hz | events missed | contacts missed; with as many at even times "
        "| decisions in both bands |",
        "|---|---|---|---|---|---|---|---|---|",
        *rows.values(),
    ]
    if write:
        fill("evidence/advice.md", "conditions", lines)
    return "\n".join(lines)
