"""Train the network by which policy `cloned` turns a wire: `python -m benchmarks turn-network --write`.

In synthetic patients of an atlas seed of its own, a wire goes towards targets. Before each fork, and before each
target, it is turned to 16 sides and pushed on, as the agent's search does, with friction and tip stiffness drawn. The
network learns which sides pass below the force limit. A fifth of the patients is kept aside to measure it.
"""

from __future__ import annotations

import contextlib
import warnings
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np

from endopilot.anatomy.catheter_axis import with_world_zero
from endopilot.atlas.atlas import make_patient
from endopilot.belief.belief import Belief, BeliefConfig
from endopilot.control.cloned import NETWORK
from endopilot.control.drive import Driver, Goal, Limits, Outcome, SearchConfig
from endopilot.control.repertoire import Row, sides, stand_off
from endopilot.control.set_up import SPARE_SHARE
from endopilot.control.trials import Trials
from endopilot.control.turn_network import AZIMUTH, FEATURES, ForkView, TurnNetwork, fourier
from endopilot.devices.device import read_wire
from endopilot.errors import InputError
from endopilot.files import writing
from endopilot.parallel import each
from endopilot.settings import Within
from endopilot.simulation.world import World
from endopilot.tasks.navigation import DECISION_PERIOD_S, Navigation, Target
from endopilot.tasks.route import Route, check_passable
from endopilot.tasks.task import Task, list_tasks

ATLAS_SEED = 5000
"""Added to the seed of a task's training patients."""
TASKS = range(1, 10)
"""Levels of the tasks whose vessels and tips are taken."""
TURNS, TURN_PERIODS, PERIODS, TRIES = 16, 2, 60, 2
"""Sides that are tried, decision periods in which the wire is turned and pushed, and how often before one fork where
none passes."""
OFF_MM, SLACK_MM = 4.0, 15.0
"""A wire that is this far in another branch, or was pushed this far and did not come forward, is given up, mm."""
TASK_SHARE = 0.75
"""Share of the navigations to the task's target; others go to any branch."""
KEPT_ASIDE = 5
"""Every fifth patient is kept aside."""
FRICTION, STIFFNESS, BEND, AHEAD = (0.7, 1.4), (0.75, 1.3), (0.85, 1.15), (0.5, 1.8)
"""Ranges of factors: of friction, tip stiffness, angle and length of the bend, and of how far before a fork it is."""
NETWORKS, WIDTH, TERMS, EPOCHS, BATCH, RATE, DECAY, DROPOUT, NOISE = 4, 128, 9, 120, 64, 3e-3, 0.03, 0.2, 0.03


@dataclass(frozen=True)
class TurnFigures:
    """What the network reaches at forks kept aside where some sides pass and others do not.

    Attributes:
        forks: trained on.
        forks_aside: of them kept aside, where it matters how the wire is turned.
        passes_as_it_is: share of these that are passed without a turn.
        passes_by_chance: and turned at random.
        passes_by_network: and turned as the network says.
    """

    forks: int
    forks_aside: int
    passes_as_it_is: float
    passes_by_chance: float
    passes_by_network: float


def train_turns(
    *, patients: Annotated[int, Within(5, 10000)] = 100, output: Path = Path("runs/turn-network"), write: bool = False
) -> TurnFigures:
    """Train the network by which policy `cloned` turns a wire. It takes some 10 s a patient on one core.

    Args:
        patients: of each of nine kinds. Those whose trials lie in the output folder are not driven again.
        output: folder of the trials.
        write: write the network into the package.
    """
    files = [output / f"{number:05d}.npz" for number in range(patients)]
    bad = each("Trials at forks", [file for file in files if not file.exists()], drive_patient)
    for error in bad.values():
        raise error
    trained = _read([file for place, file in enumerate(files) if place % KEPT_ASIDE])
    network = fit(*trained)
    if write:
        network.write(NETWORK)
    return _figures(network, len(trained[0]), *_read(files[::KEPT_ASIDE]))


def drive_patient(file: Path) -> None:
    """Drive trials in the patients of a number, one of each task, and write what became of them."""
    rows: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    for task in (task for task in list_tasks(2) if task.level in TASKS):
        random = np.random.default_rng([task.level, int(file.stem), 0x7012])
        navigation = _drawn(task, int(file.stem), random)
        try:
            check_passable(Route.to(navigation.anatomy, navigation.target), navigation.device)
        except InputError:
            continue
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a trial that fails does not pass
            rows += Forks(navigation, random).drive()
    view, azimuth, passed = (np.array(column) for column in zip(*rows, strict=True))
    with writing(file) as partial:
        np.savez_compressed(partial, view=view, azimuth=azimuth, passed=passed)


def _drawn(task: Task, number: int, random: np.random.Generator) -> Navigation:
    """Return a navigation of a task's kind in a patient of its kind."""
    assert task.training is not None
    anatomy = with_world_zero(make_patient(task.atlas(task.training.seed + ATLAS_SEED), number))
    leaf = int(random.choice(anatomy.tree.leaves()))
    line = anatomy.tree.branches[leaf].centerline.abscissa
    target = Target(branch=leaf, abscissa=float(line[0] + random.uniform(0.3, 0.9) * (line[-1] - line[0])))
    if random.random() < TASK_SHARE:
        with contextlib.suppress(InputError):  # this patient may lack the section
            target = task.target(anatomy.tree)
    bend = np.deg2rad(task.tip_bend_deg) * random.uniform(*BEND)
    wire = replace(
        read_wire(task.device),
        tip_bend_rad=min(float(bend), np.pi),
        tip_bend_length_mm=float(task.tip_bend_mm * random.uniform(*BEND)),
    )
    return Navigation(
        anatomy=anatomy,
        device=wire,
        target=target,
        start_inserted_length_mm=task.start_inserted_length_mm,
        start_rotation_rad=float(random.uniform(0.0, 2 * np.pi)),
        seconds=task.seconds,
        force_limit_n=task.force_limit_n,
    )


class Forks:
    """Trials of one navigation, before one fork after another."""

    def __init__(self, navigation: Navigation, random: np.random.Generator) -> None:
        """Lay out the wire, with friction and stiffness drawn."""
        self._navigation, self._random, self._config = navigation, random, SearchConfig()
        self._route = Route.to(navigation.anatomy, navigation.target)
        friction, stiffness = random.uniform(*FRICTION), random.uniform(*STIFFNESS)
        member = World(friction_factor=friction, tip_stiffness_factor=stiffness)
        belief = Belief(navigation, [member], BeliefConfig())
        trials = partial(Trials.of, navigation, belief.kinds, like=belief.simulator)
        self._one, self._many = trials(1), trials(TURNS)
        self._one.put(np.zeros(1, dtype=int), belief.simulator, np.ones(1))

    def drive(self) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """Return the features, the azimuths that were tried, and which passed, of each fork that the wire came to."""
        rows = []
        for at, waypoint in enumerate(self._route.waypoints.tolist()):
            for _ in range(TRIES):
                place = self._approach(at)
                view = ForkView.of(self._route, place, self._one.simulator.position[0], self._navigation.device)
                azimuth, outcome = self._try(place, waypoint)
                passed = (outcome.share == 1) & (outcome.force <= SPARE_SHARE * self._navigation.force_limit_n)
                rows.append((view.features, azimuth, passed))
                if passed.any() and self._follow(outcome, int(self._random.choice(np.flatnonzero(passed))), waypoint):
                    break
                self._one.move(self._one.control(-self._random.uniform(2.0, 8.0) / DECISION_PERIOD_S))
            else:
                break
        return rows

    def _approach(self, at: int) -> float:
        """Bring the wire to some way before a fork, or leave it where it is before the target; return the place."""
        one, route, limit_n = self._one, self._route, self._navigation.force_limit_n
        share = self._random.uniform(*AHEAD)
        if at == len(route.junctions):
            progress = float(route.progress(one.foremost)[0])
            return min(progress + share * stand_off(route, progress, self._config.lead_mm), route.target.abscissa)
        fork = float(route.junctions[at])
        goal = fork - share * stand_off(route, fork, self._config.lead_mm)
        for _ in range(PERIODS):
            progress, off = float(route.progress(one.foremost)[0]), float(route.off_route(one.foremost)[0])
            gap = goal - progress if off == 0 else -np.inf
            if abs(gap) < 1.0:
                break
            speed = np.clip(gap / DECISION_PERIOD_S, -self._config.speed_mm_s, self._config.speed_mm_s)
            one.still[:] = False
            presses = one.move(one.control(float(speed)), force_n=limit_n).any()
            if presses or (speed > 2.0 and float(route.progress(one.foremost)[0]) - progress < 0.3):
                break
        return fork

    def _try(self, place: float, waypoint: float) -> tuple[np.ndarray, Outcome]:
        """Turn the wire to all sides, and push it past a waypoint; return the azimuths, and what became of it."""
        many = self._many.copy_of(self._one, np.arange(self._one.wires))
        limit_n = self._navigation.force_limit_n
        for _ in range(TURN_PERIODS):
            rotation = sides(TURNS) / (TURN_PERIODS * DECISION_PERIOD_S)
            many.still |= many.move(many.control(turn=rotation), force_n=limit_n)
        views = (ForkView.of(self._route, place, nodes, self._navigation.device) for nodes in many.simulator.position)
        azimuth = np.array([view.azimuth for view in views])
        motions = Row(follow_mm=(0.0,) * TURNS).motions(place, 0.0, self._config, 1, self._random)
        goal, limits = Goal(self._navigation, self._route, waypoint), Limits(limit_n, OFF_MM, SLACK_MM)
        return azimuth, Driver(many, motions, goal, limits, self._config).run(PERIODS)

    def _follow(self, outcome: Outcome, trial: int, waypoint: float) -> bool:
        """Do what a trial did; return whether the wire has passed."""
        for control in outcome.controls_of(trial):
            self._one.move(control[None], force_n=self._navigation.force_limit_n)
        return bool(self._route.passed(self._one.foremost, waypoint)[0])


def fit(view: np.ndarray, azimuth: np.ndarray, passed: np.ndarray) -> TurnNetwork:
    """Return networks that say which sides pass, from forks and their mirror images."""
    import torch

    mean, scale = view.mean(axis=0), view.std(axis=0) + 0.05
    mirrored = np.array([ForkView(each, 0.0).mirrored().features for each in view])
    given = torch.tensor((np.concatenate([view, mirrored]) - mean) / scale).float()
    waves = torch.tensor(fourier(np.concatenate([azimuth, -azimuth]), TERMS)).float()
    wanted = torch.tensor(np.concatenate([passed, passed])).float()
    steps = EPOCHS * -(-len(given) // BATCH)
    networks = []
    for seed in range(NETWORKS):
        torch.manual_seed(seed)
        network = torch.nn.Sequential(
            *(torch.nn.Linear(FEATURES, WIDTH), torch.nn.SiLU(), torch.nn.Dropout(DROPOUT)),
            *(torch.nn.Linear(WIDTH, WIDTH), torch.nn.SiLU(), torch.nn.Dropout(DROPOUT)),
            torch.nn.Linear(WIDTH, TERMS),
        )
        optimizer = torch.optim.AdamW(network.parameters(), lr=RATE, weight_decay=DECAY)
        schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, RATE, total_steps=steps)
        for _ in range(EPOCHS):
            for rows in torch.randperm(len(given)).split(BATCH):
                noisy = given[rows] + NOISE * torch.randn(len(rows), FEATURES)
                logit = (network(noisy)[:, None] * waves[rows]).sum(dim=-1)
                loss = torch.nn.functional.binary_cross_entropy_with_logits(logit, wanted[rows])
                optimizer.zero_grad()
                loss.backward()
                optimizer.step()
                schedule.step()
        networks.append([layer for layer in network if isinstance(layer, torch.nn.Linear)])
    layers = tuple(
        (
            np.stack([layer.weight.detach().numpy().T for layer in same]),
            np.stack([layer.bias.detach().numpy() for layer in same]),
        )
        for same in zip(*networks, strict=True)
    )
    return TurnNetwork(mean.astype(np.float32), scale.astype(np.float32), layers)


def _read(files: list[Path]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return views, azimuths and outcomes of trials."""
    held = [np.load(file) for file in files]
    view, azimuth, passed = (np.concatenate([each[name] for each in held]) for name in ("view", "azimuth", "passed"))
    return view, azimuth, passed


def _figures(
    network: TurnNetwork, forks: int, view: np.ndarray, azimuth: np.ndarray, passed: np.ndarray
) -> TurnFigures:
    matters = np.flatnonzero(passed.any(axis=1) & ~passed.all(axis=1))
    hits = []
    for fork in matters.tolist():
        best = AZIMUTH[int(np.argmax(network.passes(ForkView(view[fork], 0.0))))]
        hits.append(passed[fork, int(np.argmax(np.cos(azimuth[fork] - best)))])
    return TurnFigures(
        forks=forks,
        forks_aside=len(matters),
        passes_as_it_is=round(float(passed[matters, TURNS // 2].mean()), 3),
        passes_by_chance=round(float(passed[matters].mean()), 3),
        passes_by_network=round(float(np.mean(hits)), 3),
    )
