"""Calibrate the X-ray adviser of the ladder's agents: `python -m benchmarks agent-calibration [KIND]`.

The agent navigates in training patients of every task of the ladder. Friction, tip stiffness and ostium differ from
its model by up to the spread of its ensemble. There is one exposure every 10 s; in between, its predictions are
compared with the truth. In some patients of each task the spread is fitted, and in the next the bands are scaled. Some
that the ladder is scored on test whether the bands hold. With KIND `assumed`, the default, exposures have the assumed
errors and patients lie at rest. With `images` the tip is found in X-ray images of patients whose pose is registered,
in the coronary tasks, and heart and breath move each patient by amplitudes of their own, of which the published mean
is known; the bands of `assumed` are scaled anew. With `coaxial` the agent drives wire and catheter in the coaxial
tasks, as in `assumed` otherwise.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np

from benchmarks.figures import fill
from endopilot.belief.bands import Calibration, conformal_scale, fit_spread, narrowest, spread_of
from endopilot.belief.monitor import predicted_tip
from endopilot.control.agent import AgentPolicy
from endopilot.control.agent_config import CALIBRATIONS, IN_CATHETER, AgentConfig
from endopilot.files import read_json, write_json
from endopilot.ladder.terms import Terms
from endopilot.navigation.loop import LoopConfig, NavigationLoop
from endopilot.navigation.policy import Decision, Observation
from endopilot.runs import claim, make_missing
from endopilot.simulation.motion import Motion, motion_named
from endopilot.simulation.world import World
from endopilot.tasks.navigation import DECISION_PERIOD_S, Navigation
from endopilot.tasks.task import CORE, NEWEST, LadderVersion, Task, find_task, list_tasks

KindName = Literal["assumed", "images", "coaxial"]
LEVEL, ONSET, EXPOSED_EVERY, SECONDS = 0.9, 0.2, 20, 30.0
"""Share of the intervals that the bands shall cover; how likely an unseen event may be; periods of 0.5 s between
exposures; seconds of a navigation."""


@dataclass(frozen=True)
class Kind:
    """What is calibrated.

    Attributes:
        config: its settings.
        version: of the ladder; `tasks` are those of it that count.
        roles: places of the patients in a task's lists: in the training list, and for the test in the ladder's.
        folder: where the calibration goes in the package.
        mark: of the table in docs/evidence/advice.md.
        whose: whose patients they are, in words.
    """

    config: AgentConfig
    version: LadderVersion
    tasks: tuple[Task, ...]
    roles: dict[str, range]
    folder: Path
    mark: str
    whose: str


KINDS: dict[KindName, Kind] = {
    "assumed": Kind(
        config=AgentConfig(),
        version=NEWEST,
        tasks=list_tasks(),
        roles={"fit": range(4), "calibrate": range(4, 9), "test": range(3)},
        folder=CALIBRATIONS["assumed", 1],
        mark="agent",
        whose="the ladder's tasks",
    ),
    "images": Kind(
        config=AgentConfig(),
        version=NEWEST,
        tasks=tuple(task for task in list_tasks() if task.vessel in ("rca", "lca")),
        roles={"calibrate": range(2)},
        folder=CALIBRATIONS["images", 1],
        mark="agent-images",
        whose="the ladder's coronary tasks",
    ),
    "coaxial": Kind(
        config=IN_CATHETER,
        version="coaxial",
        tasks=list_tasks("coaxial"),
        roles={"fit": range(3), "calibrate": range(3, 7), "test": range(3)},
        folder=CALIBRATIONS["assumed", 2],
        mark="agent-coaxial",
        whose="the ladder's coaxial tasks",
    ),
}


class MonitoredAgent(AgentPolicy):
    """The agent with exposures at fixed times, and where a manoeuvre has led; it keeps every prediction."""

    def start(self, navigation: Navigation, seed: int) -> None:
        """Begin a navigation without predictions."""
        self.kept: list[np.ndarray] = []
        super().start(navigation, seed)  # pyright: ignore[reportAttributeAccessIssue]
        self.monitor.changes_left = 0  # the bands are those of the wires as they are given

    def decide(self, observation: Observation) -> Decision:
        """Decide as the agent does, and keep the prediction."""
        decision = super().decide(observation)  # pyright: ignore[reportAttributeAccessIssue]
        at = predicted_tip(self.belief)
        self.kept.append(np.concatenate([at.proximal, at.tip, at.spread]))
        return decision

    def wants_xray(self) -> bool:
        """Ask for X-ray at the fixed times, and where a manoeuvre is over."""
        return (len(self.kept) + 1) % EXPOSED_EVERY == 0 or self._shows


def world_of(task: Task, place: int, role: str, kind: Kind) -> World:
    """Return a patient's reality, drawn within the spread of the agent's ensemble."""
    belief, roles = kind.config.belief, list(kind.roles)
    off = np.random.default_rng([task.level, place, roles.index(role)]).uniform(-1.0, 1.0, 3)
    return World(
        friction_factor=1 + belief.friction_spread * off[0],
        tip_stiffness_factor=1 + belief.stiffness_spread * off[1],
        ostium_mm=belief.ostium_spread_mm * off[2],
    )


def measure(path: Path, name: KindName) -> None:
    """Navigate in a patient, and write prediction and truth of each period after the first."""
    kind, moves = KINDS[name], name == "images"
    task, role, place = find_task(path.parent.name, version=kind.version), *path.stem.split("-")
    number = int(place)
    if role == "test":
        navigation = task.ladder_navigation(number)
    else:
        assert task.training is not None  # as every shipped task has
        turn = np.random.default_rng([task.training.seed, number]).uniform(0.0, 2 * np.pi)
        navigation = task.navigation(task.patient(task.training, number), start_rotation_rad=turn)
    policy = MonitoredAgent(replace(kind.config, tries=2), calibration=NO_BANDS)
    seed = 1000 + 100 * task.level + number
    record = NavigationLoop(
        replace(navigation, seconds=min(SECONDS, navigation.seconds), known_motion=Motion() if moves else None),
        policy,
        config=LoopConfig(
            simulator=replace(CORE, threads=1),
            xray="images" if moves else "assumed",
            motion=motion_named("both", seed) if moves else None,
        ),
        seed=seed,
        world=world_of(task, number, role, kind),
    ).run()
    kept, count = np.array(policy.kept), len(policy.kept)
    true = np.column_stack([record.tip.abscissa[:, 0], record.tip.offset[:, 0]])[:count]
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
    onset=ONSET,
    longest_s=EXPOSED_EVERY * DECISION_PERIOD_S,
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


def calibrate(folder: Path, kind: Kind) -> tuple[Calibration, list[str]]:
    """Return the calibration, and a table of its coverage as lines of Markdown."""
    if "fit" in kind.roles:
        fitted, _ = gather(folder, "fit")
        terms = fit_spread(*(np.concatenate(column) for column in zip(*fitted, strict=True)))
        terms = narrowest(terms, worst(fitted, terms), LEVEL)
    else:
        known = Calibration.read(CALIBRATIONS["assumed", 1])
        terms = known.abscissa_terms, known.offset_terms
    rows, owner = gather(folder, "calibrate")
    calibration = Calibration(
        level=LEVEL,
        scale=conformal_scale(worst(rows, terms).max(axis=1), owner, LEVEL),
        abscissa_terms=terms[0],
        offset_terms=terms[1],
        anatomies=len(np.unique(owner)),
        intervals=len(rows),
        dataset=f"patients to learn on of {kind.whose}",
        onset=ONSET,
        longest_s=EXPOSED_EVERY * DECISION_PERIOD_S,
    )
    lines = ["| patients | intervals without X-ray | in which both bands hold throughout |", "|---|---|---|"]
    for title, role in (("calibrated on", "calibrate"), ("the ladder's, not calibrated on", "test")):
        if role not in kind.roles:
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


def calibrate_agent(kind: KindName = "assumed", /, *, write: bool = False) -> str:
    """Calibrate the X-ray adviser of the ladder's agents, in the patients to learn on and in some of the ladder.

    runs/agent-calibration-KIND gets one file a navigation; an interrupted run goes on with the others.

    Args:
        kind: exposures with assumed errors in patients at rest (assumed), X-ray images of patients whom heart and
            breath move (images), or a wire in a catheter in the coaxial tasks (coaxial).
        write: write the calibration into the package, and its figures into docs/evidence/advice.md.

    Returns:
        The calibration, and a table of its coverage.

    Raises:
        InputError: the folder belongs to another run.
    """
    chosen = KINDS[kind]
    folder = Path(f"runs/agent-calibration-{kind}")
    wanted = [
        folder / task.name / f"{role}-{place:02d}.json"
        for role, places in chosen.roles.items()
        for place in places
        for task in chosen.tasks
    ]
    found = Terms(chosen.version).identity("agent")
    claim(folder, f"python -m benchmarks agent-calibration {kind}", **found, agent=chosen.config)
    make_missing("Calibrating the agent's adviser", wanted, partial(measure, name=kind))
    calibration, lines = calibrate(folder, chosen)
    if write:
        calibration.write(chosen.folder)
        fill("evidence/advice.md", chosen.mark, lines)
    return "\n".join([str(calibration), *lines])
