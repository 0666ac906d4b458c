"""The world behind the page: a wire, alone or in catheters, in one vessel, held by the simulated robot.

It advances in short cycles.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np
from jaxtyping import Float

from endopilot.devices.drive_limits import DriveLimits
from endopilot.devices.stack import lines_from_tips, shown_part
from endopilot.errors import InputError
from endopilot.navigation.navigate import start_world
from endopilot.robot.robot import RobotConfig, SimulatedRobot
from endopilot.settings import Within, settings
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.mismatch import ModelMismatch
from endopilot.simulation.simulator import Simulator
from endopilot.simulation.state import Step
from endopilot.tasks.navigation import Navigation, Target
from endopilot.types import TipProjection


@settings
class WorldConfig:
    """The simulated reality: rod core, drive, how it differs from what is known, and the length of a cycle."""

    cycle_s: Annotated[float, Within(1e-4, 0.5)] = 0.0125
    """Time from one command and picture to the next, s."""
    robot: RobotConfig = field(default_factory=RobotConfig)
    """The drive."""
    truth: ModelMismatch = field(default_factory=ModelMismatch)
    """How reality differs from the navigation."""
    simulator: SimulatorConfig = field(default_factory=lambda: SimulatorConfig(threads=1))
    """The rod core."""


@dataclass(frozen=True, eq=False)
class ShownCatheter:
    """A catheter around the wire, at the end of a cycle.

    Attributes:
        nodes: of its axis from its tip to a little behind the ostium, LPS mm.
        node_force: of the wall at each of them, N; 0 where it lies in another catheter.
        tip: Δtip, γtip, branch and lumen radius, as arrays of one.
        inserted_mm: inserted length as it truly is, mm.
        rotation: of its drive, rad.
    """

    nodes: Float[np.ndarray, "n 3"]
    node_force: Float[np.ndarray, "n"]
    tip: TipProjection
    inserted_mm: float
    rotation: float


@dataclass(frozen=True, eq=False)
class Snapshot:
    """The world at the end of a cycle.

    Attributes:
        cycle: how many have passed.
        time_s: since the start, s.
        nodes: of the wire from its tip to a little behind the ostium, LPS mm.
        node_force: of the wall at each of them, N; 0 where it lies in a catheter.
        tip_direction: unit vector along the wire at its tip.
        tip: Δtip, γtip, branch and lumen radius, as arrays of one.
        inserted_mm: Δ, mm, as it truly is.
        rotation: φ, rad.
        velocity: of the drive's motor, mm/s and rad/s of the wire, then of each catheter.
        force_n: largest wall force on one node during the cycle, N.
        wall_force_n: largest resultant of the wall on 2 mm of the wire, N.
        drive_load: push (N) and torque (N·mm) of the wire's drive, then of each catheter's.
        slip: advance (mm) and rotation (rad) that each drive was asked for and slipped over in the cycle.
        valid: false once the simulation has failed.
        catheters: around the wire, from the inside out.
    """

    cycle: int
    time_s: float
    nodes: Float[np.ndarray, "n 3"]
    node_force: Float[np.ndarray, "n"]
    tip_direction: Float[np.ndarray, "3"]
    tip: TipProjection
    inserted_mm: float
    rotation: float
    velocity: tuple[float, ...]
    force_n: float
    wall_force_n: float
    drive_load: tuple[float, ...]
    slip: tuple[float, ...]
    valid: bool
    catheters: tuple[ShownCatheter, ...] = ()

    @property
    def tips(self) -> tuple[TipProjection, ...]:
        """Those of the wire and of each catheter, as `Navigation.reached` takes them."""
        return (self.tip, *(catheter.tip for catheter in self.catheters))

    @property
    def deepest_mm(self) -> float:
        """Largest inserted length, mm."""
        return max([self.inserted_mm, *(catheter.inserted_mm for catheter in self.catheters)])


class World:
    """One wire, alone or in catheters, behind the simulated robot.

    The same commands in the same cycles give the same bits.

    Attributes:
        navigation: vessel, wire, catheters, target and start.
        config: robot, rod core and length of a cycle.
        robot: the drives, whose encoders a policy reads.
        cycle: how many cycles have passed.
        force_n: largest wall force on one node in the last cycle, N.
        peak_force_n: the same so far, N.
    """

    def __init__(self, navigation: Navigation, config: WorldConfig | None = None, *, seed: int = 0) -> None:
        """Bring wire and catheters to the navigation's start.

        Args:
            navigation: vessel, wire, catheters and start.
            config: robot, rod core and length of a cycle.
            seed: of the encoders' noise.

        Raises:
            InputError: a device does not fit the vessel, or starts deeper than it is long.
        """
        self.navigation, self.config = navigation, config or WorldConfig()
        truth = self.config.truth
        self.simulator = start_world(navigation, truth, self.config.simulator)
        self._limits = tuple(DriveLimits.of(device, navigation.anatomy) for device in navigation.devices)
        drive = replace(self.config.robot, latency_s=self.config.robot.latency_s * truth.latency_factor)
        self.robot = SimulatedRobot(self.simulator, self._limits, drive, seed=seed, ostium_mm=truth.ostium_mm)
        self.cycle, self.peak_force_n, self.force_n = 0, 0.0, 0.0
        self._taken_s = self.config.cycle_s / 10

    @property
    def time_s(self) -> float:
        """Time since the start, s."""
        return self.cycle * self.config.cycle_s

    @property
    def reserve(self) -> float:
        """Simulated time over the time that simulating it takes, lately."""
        return self.config.cycle_s / self._taken_s

    def navigation_to(self, target: Target | None) -> Navigation:
        """Return the navigation with another target, or as it is.

        Raises:
            InputError: the vessel has no such place.
        """
        return self.navigation if target is None else replace(self.navigation, target=target)

    def reaches(self, target: Target | None) -> bool:
        """Return whether a target is reached: the navigation's own if none is given."""
        navigation = self.navigation_to(target)
        return bool(navigation.reached(*map(self.simulator.project, range(navigation.arriving + 1)))[0])

    def safe(self, velocity: Sequence[float]) -> tuple[float, ...]:
        """Return what is left of velocities within the drives' limits.

        Args:
            velocity: mm/s and rad/s of the wire, then of each catheter; catheters that are not given stand still.

        Raises:
            InputError: more catheters are given than there are.
        """
        around = len(self._limits) - 1
        if len(velocity) > 2 * len(self._limits):
            raise InputError(f"catheters: {len(velocity) // 2 - 1}; this wire has {around} around it")
        padded = [*velocity, *[0.0] * (2 * len(self._limits) - len(velocity))]
        return tuple(
            each for k, limits in enumerate(self._limits) for each in limits.safe(padded[2 * k], padded[2 * k + 1])
        )

    def command(self, velocity: Sequence[float]) -> tuple[float, ...]:
        """Command the drives, and return what is left of it, as `safe` does.

        Raises:
            InputError: more catheters are given than there are.
        """
        safe = self.safe(velocity)
        self.robot.command(safe[0], safe[1], *zip(safe[2::2], safe[3::2], strict=True))
        return safe

    def stop(self) -> None:
        """Let the drives brake at once."""
        self.robot.stop()

    def advance(self) -> None:
        """Let one cycle pass."""
        began = time.perf_counter()
        self.force_n = self.robot.run(self.config.cycle_s)
        self._taken_s += 0.02 * (time.perf_counter() - began - self._taken_s)
        self.peak_force_n = max(self.peak_force_n, self.force_n)
        self.cycle += 1

    def snapshot(self) -> Snapshot:
        """Return the world as it is now."""
        velocity, step = self.robot.velocity, self.robot.last_step
        return take_snapshot(
            self.simulator,
            step,
            cycle=self.cycle,
            time_s=self.time_s,
            force_n=self.force_n,
            velocity=tuple(velocity.tolist()),
        )

    def digest(self) -> str:
        """Return a hash of the state of wire and catheters, to the bit."""
        simulator = self.simulator
        parts = [simulator.position, simulator.inserted_length, simulator.rotation, simulator.contacts]
        parts += [simulator.catheter_inserted_length, simulator.catheter_rotation]  # nothing for a wire alone
        return hashlib.sha256(b"".join(part.astype("<f8").tobytes() for part in parts)).hexdigest()[:16]


def take_snapshot(
    simulator: Simulator,
    step: Step | None,
    *,
    cycle: int,
    time_s: float,
    force_n: float,
    velocity: tuple[float, ...],
) -> Snapshot:
    """Return how the one world of a simulator is now.

    Args:
        simulator: of one world.
        step: its last step; None before the first.
        cycle: how many have passed.
        time_s: since the start, s.
        force_n: largest wall force on one node in the cycle, N.
        velocity: of the drives, mm/s and rad/s of the wire, then of each catheter.
    """
    inserted = np.append(simulator.inserted_length, simulator.catheter_inserted_length)
    (nodes, force), *around = _lines(simulator, inserted)
    turned = simulator.catheter_rotation[0].tolist()
    catheters = tuple(
        ShownCatheter(*line, simulator.project(k + 1), float(inserted[k + 1]), turned[k])
        for k, line in enumerate(around)
    )
    slip = np.zeros((1, 2)) if step is None else np.column_stack([step.slip, step.rotation_slip])
    catheter_slip = np.zeros((len(around), 2)) if step is None else simulator.catheter_slip[0]
    return Snapshot(
        cycle=cycle,
        time_s=time_s,
        nodes=nodes,
        node_force=force,
        tip_direction=simulator.tip_direction[0],
        tip=simulator.project(),
        inserted_mm=float(inserted[0]),
        rotation=float(simulator.rotation[0]),
        velocity=velocity,
        force_n=force_n,
        wall_force_n=0.0 if step is None else float(step.wall_force[0]),
        drive_load=tuple(np.append(simulator.drive_load, simulator.catheter_drive_load).tolist()),
        slip=tuple(np.append(slip, catheter_slip).tolist()),
        valid=bool(simulator.valid[0]),
        catheters=catheters,
    )


def _lines(
    simulator: Simulator, inserted_mm: Float[np.ndarray, "devices"]
) -> list[tuple[Float[np.ndarray, "_ 3"], Float[np.ndarray, "_"]]]:
    """Return what is shown of each device: nodes from its tip on, LPS mm, and the wall's force at each, N.

    The wall presses on the outermost device alone.
    """
    nodes, force = shown_part(simulator.position[0], float(inserted_mm.max())), simulator.contacts[0]
    found, covered = [], -np.inf
    for device, line in reversed(list(enumerate(lines_from_tips(nodes, inserted_mm)))):
        own = force[len(nodes) - len(line) : len(nodes)]
        if len(inserted_mm) > 1:
            along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
            line[0] = simulator.tips(device)[0]
            own = np.where(inserted_mm[device] - along > covered, own, 0.0)
            covered = max(covered, float(inserted_mm[device]))
        found.append((line, own))
    return found[::-1]
