"""The world behind the page: one wire in one vessel, held by the simulated robot, advanced in short cycles."""

from __future__ import annotations

import hashlib
import time
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from endopilot.control.mismatch import ModelMismatch
from endopilot.control.navigate import start_world
from endopilot.control.robot import RobotConfig, SimulatedRobot
from endopilot.settings import Positive, settings
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.drive_limits import DriveLimits
from endopilot.simulation.simulator import Simulator
from endopilot.simulation.state import Step
from endopilot.tasks.navigation import Navigation, Target, check_wire_alone
from endopilot.types import TipProjection

SHOWN_BEHIND_MM = 20.0
"""Length of wire that is shown behind the ostium, in the guiding catheter, mm."""


@settings
class WorldConfig:
    """The simulated reality: rod core, drive, how it differs from what is known, and the length of a cycle."""

    cycle_s: Positive = 0.0125
    """Time from one command and picture to the next, s."""
    robot: RobotConfig = field(default_factory=RobotConfig)
    """The drive."""
    truth: ModelMismatch = field(default_factory=ModelMismatch)
    """How reality differs from the navigation."""
    simulator: SimulatorConfig = field(default_factory=lambda: SimulatorConfig(threads=1))
    """The rod core."""


@dataclass(frozen=True, eq=False)
class Snapshot:
    """The world at the end of a cycle.

    Attributes:
        cycle: how many have passed.
        time_s: since the start, s.
        nodes: of the wire from its tip to a little behind the ostium, LPS mm.
        node_force: of the wall at each of them, N.
        tip_direction: unit vector along the wire at its tip.
        tip: Δtip, γtip, branch and lumen radius, as arrays of one.
        inserted_mm: Δ, mm, as it truly is.
        rotation: φ, rad.
        velocity: of the drive's motor, mm/s and rad/s.
        force_n: largest wall force on one node during the cycle, N.
        wall_force_n: largest resultant of the wall on 2 mm of the wire, N.
        drive_load: push (N) and torque (N·mm) of the drive.
        slip: advance (mm) and rotation (rad) that the drive was asked for and slipped over in the cycle.
        valid: false once the simulation has failed.
    """

    cycle: int
    time_s: float
    nodes: Float[np.ndarray, "n 3"]
    node_force: Float[np.ndarray, "n"]
    tip_direction: Float[np.ndarray, "3"]
    tip: TipProjection
    inserted_mm: float
    rotation: float
    velocity: tuple[float, float]
    force_n: float
    wall_force_n: float
    drive_load: tuple[float, float]
    slip: tuple[float, float]
    valid: bool


class World:
    """One wire in one vessel behind the simulated robot. The same commands in the same cycles give the same bits.

    Attributes:
        navigation: vessel, wire, target and start.
        config: robot, rod core and length of a cycle.
        robot: the drive, whose encoders a policy reads.
        cycle: how many cycles have passed.
        force_n: largest wall force on one node in the last cycle, N.
        peak_force_n: the same so far, N.
    """

    def __init__(self, navigation: Navigation, config: WorldConfig | None = None, *, seed: int = 0) -> None:
        """Bring the wire to the navigation's start.

        Args:
            navigation: vessel, wire and start.
            config: robot, rod core and length of a cycle.
            seed: of the encoders' noise.

        Raises:
            InputError: the wire does not fit the vessel, or starts deeper than it is long; a navigation with catheters.
        """
        check_wire_alone(navigation, "cockpit: it")
        self.navigation, self.config = navigation, config or WorldConfig()
        truth = self.config.truth
        self.simulator = start_world(navigation, truth, self.config.simulator)
        self.limits = DriveLimits.of(navigation.device, navigation.anatomy)
        drive = replace(self.config.robot, latency_s=self.config.robot.latency_s * truth.latency_factor)
        self.robot = SimulatedRobot(self.simulator, (self.limits,), drive, seed=seed, ostium_mm=truth.ostium_mm)
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

    def command(self, translation: float, rotation: float) -> tuple[float, float]:
        """Command the drive, mm/s and rad/s, and return what is left of it within the drive's limits."""
        safe = self.limits.safe(translation, rotation)
        self.robot.command(*safe)
        return safe

    def stop(self) -> None:
        """Let the drive brake at once."""
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
            velocity=(float(velocity[0]), float(velocity[1])),
        )

    def digest(self) -> str:
        """Return a hash of the wire's state, to the bit."""
        simulator = self.simulator
        parts = (simulator.position, simulator.inserted_length, simulator.rotation, simulator.contacts)
        return hashlib.sha256(b"".join(part.astype("<f8").tobytes() for part in parts)).hexdigest()[:16]


def take_snapshot(
    simulator: Simulator,
    step: Step | None,
    *,
    cycle: int,
    time_s: float,
    force_n: float,
    velocity: tuple[float, float],
) -> Snapshot:
    """Return how the one world of a simulator is now.

    Args:
        simulator: of one world.
        step: its last step; None before the first.
        cycle: how many have passed.
        time_s: since the start, s.
        force_n: largest wall force on one node in the cycle, N.
        velocity: of the drive, mm/s and rad/s.
    """
    nodes, inserted = simulator.position[0], float(simulator.inserted_length[0])
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(nodes, axis=0), axis=1))])
    shown = along <= inserted + SHOWN_BEHIND_MM
    load = simulator.drive_load[0]
    return Snapshot(
        cycle=cycle,
        time_s=time_s,
        nodes=nodes[shown],
        node_force=simulator.contacts[0][shown],
        tip_direction=simulator.tip_direction[0],
        tip=simulator.project(),
        inserted_mm=inserted,
        rotation=float(simulator.rotation[0]),
        velocity=velocity,
        force_n=force_n,
        wall_force_n=0.0 if step is None else float(step.wall_force[0]),
        drive_load=(float(load[0]), float(load[1])),
        slip=(0.0, 0.0) if step is None else (float(step.slip[0]), float(step.rotation_slip[0])),
        valid=bool(simulator.valid[0]),
    )
