"""Trials of a stack of devices that are driven side by side: `Trials`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from endopilot.belief.thought import Budget
from endopilot.control.course import Course
from endopilot.devices.drive_limits import DriveLimits
from endopilot.devices.stack import Stack
from endopilot.simulation.simulator import Simulator
from endopilot.simulation.trajectory import SimulatorState, Step
from endopilot.tasks.navigation import DECISION_PERIOD_S, Navigation
from endopilot.tasks.route import Route
from endopilot.types import Anatomy, TipProjection

Each = Float[np.ndarray, "trials"]
Control = Float[np.ndarray, "trials devices 2"]
"""Translation (mm/s) and rotation (rad/s) of each device of each trial in a decision period."""
_SHORT_MM = 1.0
"""A course leaves this much of the travel unused, mm: encoders err."""
_LOOKS = 5
"""Times in a period at which forces are read: a tip that is caught presses harder until it snaps, within some tenths
of a second."""
_TIP = tuple(TipProjection.__dataclass_fields__)


WIRE, CATHETER = 0, 1
"""Places of devices in a stack: the wire, and the catheter next to it."""


class Period(NamedTuple):
    """What trials did in a decision period, and where they were at its end; of worlds as `Trials` has them.

    Attributes:
        control: of each trial.
        proximal: inserted length (mm) and rotation (rad) of each world's devices.
        tip: of each world's wire.
        force: largest wall force on a node of each world within the period, N.
    """

    control: Control
    proximal: Float[np.ndarray, "worlds devices 2"]
    tip: TipProjection
    force: Float[np.ndarray, "worlds"]


class Kept(NamedTuple):
    """Where trials were: their state, and what they had done, period by period."""

    state: SimulatorState
    rows: list[Period]


class Trials:
    """Trials of a stack that are driven side by side.

    Each is driven alike in several worlds, one for every wire that is held possible: in the first worlds are all trials
    of the first wire, then those of the next. What a trial is judged by is the weighted mean over its wires, or what
    holds for all that count.

    Attributes:
        simulator: the worlds.
        wires, count, devices: numbers of wires, of trials, and of devices in a stack.
        fastest: translation (mm/s) and rotation (rad/s) of the wire's drive at most.
        weight: how likely each wire is; one of 5 % or less goes along and does not count.
        still: which trials stand still, whatever they are driven to do: no time passes for them.
        rows: what they have done, period by period.
    """

    def __init__(
        self, simulator: Simulator, limits: Sequence[DriveLimits], *, wires: int = 1, budget: Budget | None = None
    ) -> None:
        """Take worlds as trials: of so many wires, within the limits of each device's drive, driven at a budget."""
        self.simulator, self.wires, self._budget = simulator, wires, budget or Budget()
        self.count, self.devices = simulator.worlds // wires, simulator.devices
        self._limits, self.fastest = list(limits), limits[0].fastest
        self._seen: tuple[np.ndarray, TipProjection] | None = None
        self._forget(np.full(wires, 1 / wires))

    @staticmethod
    def of(
        navigation: Navigation,
        kinds: Sequence[tuple[Anatomy, Stack]],
        count: int,
        *,
        like: Simulator,
        budget: Budget | None = None,
    ) -> Trials:
        """Return so many trials of the vessels and devices that are held possible, `like` a simulator of these."""
        anatomies, stacks = zip(*(kind for kind in kinds for _ in range(count)), strict=True)
        simulator = Simulator(anatomies, stacks, motion=navigation.known_motion, config=like.config)
        limits = [DriveLimits.of(device, navigation.anatomy) for device in stacks[0].devices]
        first, last = limits[0].travel_mm
        travel = first, last - _SHORT_MM
        limits = [replace(each, travel_mm=travel) for each in limits]
        return Trials(simulator, limits, wires=len(kinds), budget=budget)

    def put(self, source: Int[np.ndarray, "wires"], of: Simulator, weight: Float[np.ndarray, "wires"]) -> None:
        """Put all trials of each wire where its source, a world `of` a simulator of equal stacks, is, and forget what
        they have done.
        """
        self.simulator.copy_worlds(np.repeat(source, self.count), of=of)
        self._forget(weight)

    def copy_of(self, one: Trials, wires: Int[np.ndarray, "wires"]) -> Trials:
        """Put all trials where some wires of one trial are; return these."""
        self.put(wires, one.simulator, one.weight[wires] / one.weight[wires].sum())
        return self

    def copy_trials(self, chosen: Int[np.ndarray, "trials"]) -> None:
        """Put each trial where another one is, as if it had done what that one has done."""
        worlds = (np.arange(self.wires)[:, None] * self.count + chosen).ravel()
        self.simulator.copy_worlds(worlds)
        self._seen = None
        self.rows = [
            Period(row.control[chosen], row.proximal[worlds], row.tip[worlds], row.force[worlds]) for row in self.rows
        ]

    def _forget(self, weight: Float[np.ndarray, "wires"]) -> None:
        self.weight, self._seen = weight, None
        self.rows: list[Period] = []
        self.still = np.zeros(self.count, dtype=bool)

    @property
    def counted(self) -> Bool[np.ndarray, "wires"]:
        """Which wires count: those of a weight above 5 %."""
        return self.weight > 0.05

    def _see(self) -> tuple[Float[np.ndarray, "worlds devices 2"], TipProjection]:
        """Return where proximal ends and tips are, which is asked of the simulator once."""
        if self._seen is None:
            self._seen = self.simulator.at_drive, self.simulator.project()
        return self._seen

    @property
    def tips(self) -> TipProjection:
        """Tips of each world's devices."""
        return self._see()[1]

    @property
    def lengths(self) -> Float[np.ndarray, "worlds devices"]:
        """Inserted lengths of each world's devices, mm."""
        return self._see()[0][..., 0]

    @property
    def foremost(self) -> TipProjection:
        """Each world's foremost tip, that of the device which is inserted farthest."""
        return self.tips[np.arange(self.simulator.worlds), self.lengths.argmax(axis=1)]

    def inserted(self, device: int) -> Float[np.ndarray, "trials"]:
        """Return the inserted lengths of a device, mm."""
        return self.mean(self.lengths[:, device])

    @property
    def deepest(self) -> Float[np.ndarray, "trials"]:
        """Inserted length of each trial's foremost device, mm."""
        return self.mean(self.lengths.max(axis=1))

    def progress(self, route: Route) -> Float[np.ndarray, "trials"]:
        """Return how far along a route each trial's foremost device has come, mm."""
        return self.mean(route.progress(self.foremost))

    def mean(self, values: Float[np.ndarray, "worlds"] | Bool[np.ndarray, "worlds"]) -> Float[np.ndarray, "trials"]:
        """Return the mean over the wires, by weight."""
        return self.weight @ values.reshape(self.wires, -1)

    def all(self, holds: Bool[np.ndarray, "worlds"]) -> Bool[np.ndarray, "trials"]:
        """Return where something holds for all wires that count."""
        return np.asarray(holds.reshape(self.wires, -1)[self.counted].all(axis=0))

    def control(self, *speeds: Each | float, turn: Each | float = 0.0) -> Control:
        """Return the control that moves devices, the wire first, at some speeds, mm/s, and turns the wire, rad/s."""
        control = np.zeros((self.count, self.devices, 2))
        for device, speed in enumerate(speeds):
            control[:, device, 0] = speed
        control[:, WIRE, 1] = turn
        return control

    def possible(self, control: Control) -> Control:
        """Return what the drives can do of a control in a decision period: no wire of a trial leaves the travel."""
        made = np.array(control)
        for device, limits in enumerate(self._limits):
            inserted = self.lengths[:, device].reshape(self.wires, -1)
            for length in (inserted.min(axis=0), inserted.max(axis=0)):
                made[:, device] = limits.clip(made[:, device], length, DECISION_PERIOD_S)
        return made

    def move(self, control: Control, *, force_n: float = np.inf) -> Bool[np.ndarray, "trials"]:
        """Drive those that do not stand still for a decision period, as far as the drives can; return which press on a
        node of the wall with more than a force, N, or fail.
        """
        step = self.drive(self.possible(np.where(self.still[:, None, None], 0.0, control)))
        return ~self.still & ~self.all(step.valid & (step.contact_force_max <= force_n))

    def drive(self, control: Control) -> Step:
        """Drive those that do not stand still for a decision period; return their worlds at its end, with the largest
        force within it.

        Raises:
            OutOfBudgetError: the search has spent its budget.
        """
        moves = np.tile(~self.still, self.wires)
        step = drive_period(self.simulator, np.tile(control, (self.wires, 1, 1)), self._budget, worlds=moves)
        self._seen = None
        proximal, tips = self._see()
        self.rows.append(Period(control, proximal, tips[:, WIRE], step.contact_force_max))
        return step

    def kept(self) -> Kept:
        """Return where they are."""
        return Kept(self.simulator.state, list(self.rows))

    def restore(self, kept: Kept) -> None:
        """Put them to where they were; what they have done since is forgotten."""
        self.simulator.set_state(kept.state)
        self.still[:], self._seen = False, None
        self.rows = list(kept.rows)

    def as_course(self, *, reached: float, ostium_mm: float, settled: Sequence[int] | None) -> Course:
        """Return what the first trial has done as a course, whose first wire's devices lie `ostium_mm` deeper than the
        encoders say. It is checked, under X-ray, at the end of the periods `settled`; if None, at every one without.
        """
        ends = np.isin(np.arange(len(self.rows)), settled or ())
        columns = {name: np.array([getattr(row.tip, name) for row in self.rows]) for name in _TIP}
        columns = {name: column.reshape(-1, self.wires)[:, self.counted] for name, column in columns.items()}
        columns["branch"] = columns["branch"].astype(int)
        proximal = np.array([row.proximal[0] for row in self.rows]).reshape(-1, self.devices, 2)
        return Course(
            control=np.array([row.control[0] for row in self.rows]).reshape(-1, self.devices, 2),
            proximal=proximal - [ostium_mm, 0.0],
            tip=TipProjection(**columns),
            force=np.array([row.force for row in self.rows]).reshape(-1, self.wires),
            checked=np.ones_like(ends) if settled is None else ends,
            exposed=ends,
            reached=reached,
        )


def drive_period(
    simulator: Simulator,
    control: Float[np.ndarray, "worlds *devices 2"],
    budget: Budget | None = None,
    *,
    worlds: Bool[np.ndarray, "worlds"] | None = None,
) -> Step:
    """Drive worlds, all if none are chosen, for a decision period, at a budget; one that fails stays where it was.

    The worlds at the end of the period are returned, but with the largest `contact_force_max` within it.
    """
    steps = list[Step]()
    for _ in range(_LOOKS):
        steps.append(simulator.step(control, DECISION_PERIOD_S / _LOOKS, worlds=worlds))
        if budget is not None:
            budget.simulated(simulator, steps[-1])
    return replace(steps[-1], contact_force_max=np.max([step.contact_force_max for step in steps], axis=0))
