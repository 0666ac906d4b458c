"""The world behind the page: a wire, alone or in catheters, in one vessel, moved by the simulated robot in short
cycles."""

from __future__ import annotations

import hashlib
import time
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from endopilot.devices.stack import Proximals, lines_from_tips, shown_part
from endopilot.errors import InputError
from endopilot.lines import length_along
from endopilot.navigation.loop import LoopConfig, NavigationLoop
from endopilot.navigation.policy import Hand, Observation
from endopilot.simulation.simulator import Simulator
from endopilot.simulation.world import World
from endopilot.tasks.navigation import Navigation
from endopilot.types import TipProjection

BY_HAND = LoopConfig(cycle_s=0.0125)  # a hand's commands act sooner than a policy's, and pages show as many pictures


@dataclass(frozen=True, eq=False)
class ShownDevice:
    """Wire or catheter at the end of a cycle: nodes of its axis from its tip to a little behind the ostium, LPS mm, the
    wall's force on each, N (0 where it lies in a catheter), its tip as arrays of one, the true Δ, mm, and φ, rad."""

    nodes: Float[np.ndarray, "n 3"]
    node_force: Float[np.ndarray, "n"]
    tip: TipProjection
    inserted_length_mm: float
    rotation: float


@dataclass(frozen=True, eq=False)
class Snapshot(ShownDevice):
    """The wire, the catheters around it from the inside out, and the world, at the end of a cycle. Of the wire and then
    of each catheter: the motor's velocity (mm/s, rad/s), the drive's push (N) and torque (N·mm), and the advance (mm)
    and rotation (rad) that it slipped over. `force_n` is the largest wall force on one node during the cycle, N;
    `valid` is false once the simulation has failed."""

    cycle: int
    time_s: float
    velocity: tuple[float, ...]
    force_n: float
    drive_load: tuple[float, ...]
    slip: tuple[float, ...]
    valid: bool
    catheters: tuple[ShownDevice, ...] = ()

    @property
    def deepest_mm(self) -> float:
        """Largest inserted length, mm."""
        return max(device.inserted_length_mm for device in (self, *self.catheters))


class LiveWorld:
    """A navigation loop that a hand drives in short cycles, beyond its end too, and what pages show of it: the same
    commands in the same cycles give the same bits. `force_n` is the largest wall force on one node in the last cycle,
    `peak_force_n` so far, N."""

    def __init__(
        self, navigation: Navigation, config: LoopConfig = BY_HAND, *, seed: int = 0, reality: World | None = None
    ) -> None:
        """Bring the devices to the start; InputError if one does not fit the vessel, or is shorter than its start."""
        self.hand, self.config = Hand(), config
        self.loop = NavigationLoop(navigation, self.hand, config=config, seed=seed, world=reality)
        self.reality = self.loop.world
        self.loop.hand_over(self.hand)
        self.cycle, self.peak_force_n, self.force_n = 0, 0.0, 0.0
        self._taken_s = config.cycle_s / 10

    @property
    def navigation(self) -> Navigation:
        """Vessel, wire, catheters, target and start."""
        return self.loop.navigation

    @property
    def time_s(self) -> float:
        """Time since the start, s."""
        return self.cycle * self.config.cycle_s

    @property
    def reserve(self) -> float:
        """Simulated time over the time that simulating it takes, lately."""
        return self.config.cycle_s / self._taken_s

    def command(self, devices: Proximals) -> Proximals:
        """Let the hand hold velocities; return what the robot took of them. InputError for too many devices."""
        around = len(self.navigation.catheters)
        if len(devices) > 1 + around:
            raise InputError(f"catheters: {len(devices) - 1}; this wire has {around} around it")
        self.hand.devices = self.loop.robot.command(devices)
        return self.hand.devices

    def stop(self) -> None:
        """Let go, and let the drives brake at once."""
        self.hand.devices = ()
        self.loop.robot.stop()

    def observe(self) -> Observation:
        """Begin a decision period for whoever drives; `loop.take` is to follow."""
        if self.loop.reason is not None:
            self.loop.go_on()
        return self.loop.observe()

    def begin(self) -> Observation:
        """Begin a decision period by hand, and return what is observed then."""
        observation = self.observe()
        self.loop.take(self.hand.decide(observation))
        return observation

    def advance(self) -> None:
        """Let one cycle pass; the hand decides where a decision is due."""
        began = time.perf_counter()
        if self.loop.between_periods:
            self.begin()
        self.force_n = self.loop.advance(self.config.cycle_s)
        self._taken_s += 0.02 * (time.perf_counter() - began - self._taken_s)
        self.peak_force_n = max(self.peak_force_n, self.force_n)
        self.cycle += 1

    def snapshot(self) -> Snapshot:
        """Return the world as it is now."""
        return loop_snapshot(self.loop, cycle=self.cycle, force_n=self.force_n)

    def digest(self) -> str:
        """Return a hash of the state of wire and catheters, to the bit."""
        simulator = self.loop.simulator
        inserted, turned = simulator.inserted_length, simulator.rotation
        parts = [simulator.position, inserted[:, 0], turned[:, 0], simulator.contacts, inserted[:, 1:], turned[:, 1:]]
        return hashlib.sha256(b"".join(part.astype("<f8").tobytes() for part in parts)).hexdigest()[:16]


def loop_snapshot(loop: NavigationLoop, *, cycle: int, force_n: float) -> Snapshot:
    """Return how the world of a navigation is after a number of the drives' cycles; `force_n` as in `Snapshot`."""
    return take_snapshot(
        loop.simulator,
        cycle=cycle,
        time_s=cycle * loop.config.cycle_s,
        force_n=force_n,
        velocity=tuple(loop.robot.velocity.ravel().tolist()),
    )


def take_snapshot(
    simulator: Simulator, *, cycle: int, time_s: float, force_n: float, velocity: tuple[float, ...]
) -> Snapshot:
    """Return how the one world of a simulator is now; `force_n` and `velocity` as in `Snapshot`."""
    inserted, turned, tip = simulator.inserted_length[0], simulator.rotation[0].tolist(), simulator.project()
    wire, *catheters = (
        ShownDevice(*line, tip[:, k], float(inserted[k]), turned[k])
        for k, line in enumerate(_lines(simulator, inserted))
    )
    return Snapshot(
        **vars(wire),
        cycle=cycle,
        time_s=time_s,
        velocity=velocity,
        force_n=force_n,
        drive_load=tuple(simulator.drive_load[0].ravel().tolist()),
        slip=tuple(simulator.slip[0].ravel().tolist()),
        valid=bool(simulator.valid[0]),
        catheters=tuple(catheters),
    )


def _lines(
    simulator: Simulator, inserted_length_mm: Float[np.ndarray, "devices"]
) -> list[tuple[Float[np.ndarray, "_ 3"], Float[np.ndarray, "_"]]]:
    """Return each device's nodes from the tip on, LPS mm, and the wall's force on them, N, on the outermost alone."""
    nodes, force = shown_part(simulator.position[0], float(inserted_length_mm.max())), simulator.contacts[0]
    found, covered = [], -np.inf
    for device, line in reversed(list(enumerate(lines_from_tips(nodes, inserted_length_mm)))):
        own = force[len(nodes) - len(line) : len(nodes)]
        if len(inserted_length_mm) > 1:
            along = length_along(line)
            line[0] = simulator.tip_position[0, device]
            own = np.where(inserted_length_mm[device] - along > covered, own, 0.0)
            covered = max(covered, float(inserted_length_mm[device]))
        found.append((line, own))
    return found[::-1]
