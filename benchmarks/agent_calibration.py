"""Calibrate the X-ray adviser of the ladder's `agent`: `python benchmarks/agent_calibration.py [XRAY] [--write]`.

The agent navigates in training patients of every task of the ladder. Friction, tip stiffness and ostium differ from
its model by up to the spread of its ensemble. There is one exposure every 10 s; in between, its predictions are
compared with the truth. In some patients of each task the spread is fitted, and in the next the bands are scaled. Some
that the ladder is scored on test whether the bands hold. With XRAY `assumed`, the default, exposures have the assumed
errors and patients lie at rest. With `images` the tip is found in X-ray images of patients whose pose is registered,
in the coronary tasks, and heart and breath move each patient by amplitudes of their own, of which the published mean
is known; the bands of `assumed` are scaled anew. runs/agent-calibration-XRAY gets one file a navigation; an
interrupted run goes on with the others.

With `--write` the calibration goes into the package, and the figures into docs/xray.md.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import get_args

import numpy as np

from endopilot.control.agent import CALIBRATED, CALIBRATIONS, AgentConfig, AgentPolicy
from endopilot.control.mismatch import ModelMismatch
from endopilot.control.navigate import NavigateConfig, navigate
from endopilot.control.policy import Decision, Observation
from endopilot.errors import InputError
from endopilot.files import read_json, write_json
from endopilot.ladder.ladder import identity
from endopilot.runs import claim, make_missing
from endopilot.simulation.motion import Motion, motion_named
from endopilot.tasks.navigation import DECISION_PERIOD_S, Navigation, XrayKind
from endopilot.tasks.task import CORE, NEWEST, Task, find_task, ladder_tasks
from endopilot.xray.bands import Calibration, balanced, conformal_scale, fit_spread, spread_of

ROOT = Path(__file__).parents[1]
RUNS = ROOT / "runs"
ROLES: dict[XrayKind, dict[str, range]] = {
    "assumed": {"fit": range(4), "calibrate": range(4, 9), "test": range(3)},
    "images": {"calibrate": range(2)},
}
"""Places of the patients in the task's lists: in the training list, and for the test in the ladder's."""
ANATOMIES: dict[XrayKind, tuple[str, ...]] = {
    "assumed": ("rca", "lca", "cerebral", "arch", "portal"),
    "images": ("rca", "lca"),
}
PLACES = {"assumed": ("agent", "the ladder's tasks"), "images": ("agent-images", "the ladder's coronary tasks")}
"""Mark of the table in docs/xray.md, and whose patients they are."""
LEVEL, EXPOSED_EVERY, SECONDS = 0.9, 20, 30.0
"""Share of the intervals that the bands shall cover; periods of 0.5 s between exposures; seconds of a navigation."""


class Monitored(AgentPolicy):
    """The agent with exposures at fixed times; it keeps every prediction."""

    def start(self, navigation: Navigation, seed: int) -> None:
        """Begin a navigation without predictions."""
        self.kept: list[np.ndarray] = []
        super().start(navigation, seed)

    def decide(self, observation: Observation) -> Decision:
        """Decide as the agent does, and keep the prediction."""
        decision = super().decide(observation)
        proximal, tip, spread, _ = self.adviser_input()
        self.kept.append(np.concatenate([proximal[0], tip[0], spread[0]]))
        return decision

    def wants_xray(self) -> bool:
        """Ask for X-ray at the fixed times."""
        return (len(self.kept) + 1) % EXPOSED_EVERY == 0


def truth_of(task: Task, place: int, role: str, xray: XrayKind) -> ModelMismatch:
    """Return a patient's model mismatch, drawn within the spread of the agent's ensemble."""
    belief, roles = AgentConfig().belief, list(ROLES[xray])
    off = np.random.default_rng([task.level, place, roles.index(role)]).uniform(-1.0, 1.0, 3)
    return ModelMismatch(
        friction_factor=1 + belief.friction_spread * off[0],
        stiffness_factor=1 + belief.stiffness_spread * off[1],
        ostium_mm=belief.ostium_spread_mm * off[2],
    )


def measure(path: Path, xray: XrayKind) -> None:
    """Navigate in a patient, and write prediction and truth of each period after the first."""
    task, role, place = find_task(path.parent.name), *path.stem.split("-")
    number = int(place)
    if role == "test":
        navigation = task.ladder_navigation(number)
    else:
        turn = np.random.default_rng([task.training.seed, number]).uniform(0.0, 2 * np.pi)
        navigation = task.navigation(task.patient(task.training, number), start_rotation=turn)
    policy = Monitored(AgentConfig(tries=2), calibration=NO_BANDS)
    seed, moves = 1000 + 100 * task.level + number, xray == "images"
    record = navigate(
        replace(navigation, seconds=min(SECONDS, navigation.seconds), known_motion=Motion() if moves else None),
        policy,
        config=NavigateConfig(
            simulator=replace(CORE, threads=1), xray=xray, motion=motion_named("both", seed) if moves else None
        ),
        seed=seed,
        truth=truth_of(task, number, role, xray),
    )
    kept, count = np.array(policy.kept), len(policy.kept)
    true = np.column_stack([record.tip.abscissa, record.tip.offset])[:count]
    exposed = record.exposed[:count]
    write_json(path, {"predicted": kept.tolist(), "true": true.tolist(), "exposed": exposed.tolist()})


NO_BANDS = Calibration(
    level=LEVEL,
    scale=0.0,
    abscissa_terms=(0.0,) * 4,
    offset_terms=(0.0,) * 4,
    anatomies=1,
    intervals=1,
    dataset="",
    heeded=1.0,
)


def intervals(content: dict) -> list[tuple[np.ndarray, ...]]:
    """Return error (mm), time (s) and travel (mm) since the exposure, and spread (mm), of each interval without one."""
    predicted, true, exposed = np.array(content["predicted"]), np.array(content["true"]), np.array(content["exposed"])
    begins = np.flatnonzero(exposed)
    found = []
    for begin, end in zip(begins, np.append(begins[1:], len(exposed)), strict=True):
        part = slice(begin + 1, end)  # the prediction at an exposure is the measurement
        if end - begin < 2:
            continue
        seconds = DECISION_PERIOD_S * np.arange(1, end - begin)
        travel = np.cumsum(np.abs(np.diff(predicted[begin:end, 0])))
        found.append((true[part] - predicted[part, 2:4], seconds, travel, predicted[part, 4:6]))
    return found


def gather(folder: Path, role: str) -> tuple[list[tuple[np.ndarray, ...]], np.ndarray]:
    """Return the intervals of a role, and the patient of each."""
    rows, owner = [], []
    for path in sorted(folder.glob(f"*/{role}-*.json")):
        of_one = intervals(read_json(path))
        rows += of_one
        owner += [f"{path.parent.name}/{path.stem}"] * len(of_one)
    return rows, np.array(owner)


def worst(rows: list[tuple[np.ndarray, ...]], terms: tuple[tuple[float, ...], tuple[float, ...]]) -> np.ndarray:
    """Return of each interval the largest error over the spread, of Δtip and of γtip."""
    return np.array([np.max(np.abs(error) / spread_of(terms, *rest), axis=0) for error, *rest in rows])


def calibrate(folder: Path, xray: XrayKind) -> tuple[Calibration, list[str]]:
    """Return the calibration, and a table of its coverage as lines of Markdown."""
    if "fit" in ROLES[xray]:
        fitted, _ = gather(folder, "fit")
        terms = fit_spread(*(np.concatenate(column) for column in zip(*fitted, strict=True)))
        terms = balanced(terms, worst(fitted, terms), LEVEL)
    else:
        known = Calibration.read(CALIBRATED)
        terms = known.abscissa_terms, known.offset_terms
    rows, owner = gather(folder, "calibrate")
    calibration = Calibration(
        level=LEVEL,
        scale=conformal_scale(worst(rows, terms).max(axis=1), owner, LEVEL),
        abscissa_terms=terms[0],
        offset_terms=terms[1],
        anatomies=len(np.unique(owner)),
        intervals=len(rows),
        dataset=f"patients to learn on of {PLACES[xray][1]}",
        heeded=1.0,
    )
    lines = ["| patients | intervals without X-ray | in which both bands hold throughout |", "|---|---|---|"]
    for title, role in (("calibrated on", "calibrate"), ("the ladder's, not calibrated on", "test")):
        if role not in ROLES[xray]:
            continue
        rows, owner = gather(folder, role)
        held = float(np.mean(worst(rows, terms).max(axis=1) <= calibration.scale))
        lines.append(f"| {title}: {len(np.unique(owner))} | {len(rows)} | {100 * held:.1f} % |")
    half = calibration.scale * np.concatenate([spread_of(terms, *rest) for _, *rest in rows])
    error = np.abs(np.concatenate([row[0] for row in rows]))
    lines += [
        "",
        f"Mean error of Δtip and γtip: {error[:, 0].mean():.2f} and {error[:, 1].mean():.2f} mm, medians "
        f"{np.median(error[:, 0]):.2f} and {np.median(error[:, 1]):.2f} mm; median half-width of the bands: "
        f"{np.median(half[:, 0]):.2f} and {np.median(half[:, 1]):.2f} mm.",
    ]
    return calibration, lines


def main() -> None:
    """Run the missing navigations, calibrate, print, and write if asked to."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("xray", nargs="?", choices=get_args(XrayKind), default="assumed")
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    xray: XrayKind = options.xray
    folder, tasks = RUNS / f"agent-calibration-{xray}", [t for t in ladder_tasks() if t.anatomy in ANATOMIES[xray]]
    wanted = [
        folder / task.name / f"{role}-{place:02d}.json"
        for role, places in ROLES[xray].items()
        for place in places
        for task in tasks
    ]
    try:
        claim(folder, f"benchmarks/agent_calibration.py {xray}", **identity("agent", NEWEST), agent=AgentConfig())
        make_missing("Calibrating the agent's adviser", wanted, partial(measure, xray=xray))
    except InputError as error:
        raise SystemExit(str(error)) from error
    calibration, lines = calibrate(folder, xray)
    print(calibration, *lines, sep="\n")
    if options.write:
        calibration.write(CALIBRATIONS[xray])
        page = ROOT / "docs" / "xray.md"
        name = PLACES[xray][0]
        begin, end = f"<!-- {name}:begin -->", f"<!-- {name}:end -->"
        text = page.read_text(encoding="utf-8")
        text = "\n".join([text.split(begin)[0] + begin, *lines, end + text.split(end)[1]])
        page.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
