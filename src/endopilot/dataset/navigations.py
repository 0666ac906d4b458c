"""Random navigations of one anatomy, drawn (`draw_navigations`) and simulated (`simulate_navigations`).

A segmented vessel ends where the scan no longer shows it, not where blood stops: so before every sample the drive
checks each device's tip, and stops pushing shortly before the end of its branch. There, and where it is caught, it
pulls instead until it has come back far enough. Simulating the recorded controls without these checks gives the same
again.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from endopilot.dataset.config import DatasetConfig
from endopilot.dataset.schema import OF_ROBOT
from endopilot.devices.device import Wire
from endopilot.devices.drive_limits import DriveLimits, within_travel
from endopilot.devices.robot import RobotConfig
from endopilot.devices.stack import Stack
from endopilot.simulation.checks import check_shape_memory
from endopilot.simulation.controls import free_wire_load, random_controls
from endopilot.simulation.motion import Motion, motion_named
from endopilot.simulation.robots import Recorder, Robots
from endopilot.simulation.simulator import Simulator
from endopilot.simulation.trajectory import SimulationSetUp, Trajectory
from endopilot.simulation.world import World
from endopilot.types import SAMPLE_PERIOD_S, Anatomy, TipProjection, VesselTree

TIP_GROUP = 8  # navigations, from the first on, that share a drawn tip: a simulation has one rod
SURPLUS = (1.0, 3.0)
"""Range of what a navigation's drawn velocities are multiplied by before they become loads of the drive: how much more
than a free wire needs. It is drawn uniformly, and the result kept within the device's fastest velocities."""


@dataclass(frozen=True, eq=False)
class Draw:
    """What was drawn of navigations: the devices' start (Δ mm, φ rad), velocities (mm/s, rad/s) or loads (N, N·mm) of
    their drives, friction, tips (the factor is on the stiffness of the distal 10 mm) and seeds of the robots."""

    initial: Float[np.ndarray, "n devices 2"]
    control: Float[np.ndarray, "n samples devices 2"]
    friction: Float[np.ndarray, "n"]
    tip_bend_rad: Float[np.ndarray, "n"]
    tip_stiffness_factor: Float[np.ndarray, "n"]
    seeds: tuple[tuple[int, int], ...] = ()


def stacks_with_tips(
    given: Stack, world: World, tip_bend_rad: Float[np.ndarray, "n"], tip_stiffness_factor: Float[np.ndarray, "n"]
) -> list[Stack]:
    """Return each navigation's devices as they are in a world, with the tip drawn for it: one object for each tip."""
    tips, made = list(zip(tip_bend_rad.tolist(), tip_stiffness_factor.tolist(), strict=True)), dict[Any, Stack]()
    for bend_rad, factor in dict.fromkeys(tips):
        wire = given.wire.with_tip(bend_rad=bend_rad, stiffness_factor=factor)
        made[bend_rad, factor] = world.stack(replace(given, wire=wire))
    return [made[tip] for tip in tips]


def draw_navigations(
    config: DatasetConfig, device: Wire, anatomy: Anatomy, sequences: range, *, devices: int = 1
) -> Draw:
    """Draw some navigations of an anatomy; each is the same whatever the number of the others. Each of `devices` is
    driven independently; the wire's draw is the same with and without catheters."""
    controls, friction, tip, surplus, _, robots = _streams(config, anatomy.name)
    initial, control = random_controls(
        config.navigation,
        devices=devices,
        n_sequences=len(sequences),
        n_samples=config.samples,
        seed=int(controls.generate_state(1, np.uint64)[0]),
        max_inserted_length_mm=float(anatomy.tree.longest_path().abscissa[-1]),
        first=sequences.start,
    )
    groups = np.array(sequences) // TIP_GROUP
    bend, stiffness = np.moveaxis(_uniform(tip, (0.0, 1.0), (sequences.stop // TIP_GROUP + 1, 2))[groups], 1, 0)
    own = config.friction or (device.friction, device.friction)
    if config.control == "force":
        free = control * _uniform(surplus, SURPLUS, sequences.stop)[sequences.start :, None, None, None]
        control = _loads(config, device, free)
    return Draw(
        initial=initial,
        control=control,
        friction=_uniform(friction, own, sequences.stop)[sequences.start :],
        tip_bend_rad=device.tip_bend_rad * _within(config.tip_bend_factor, bend),
        tip_stiffness_factor=_within(config.tip_stiffness_factor, stiffness),
        seeds=tuple((int(robots.generate_state(1, np.uint64)[0]), index) for index in sequences),
    )


def patient_motion(config: DatasetConfig, anatomy: str) -> Motion | None:
    """Return how the vessel of an anatomy moves in the navigations of a dataset; None if it lies still."""
    return motion_named(config.motion, int(_streams(config, anatomy)[4].generate_state(1, np.uint64)[0]))


def _streams(config: DatasetConfig, anatomy: str) -> list[np.random.SeedSequence]:
    name_number = int.from_bytes(hashlib.sha256(anatomy.encode()).digest()[:8], "little")
    return np.random.SeedSequence([config.seed, name_number]).spawn(6)


def _uniform(
    seed: np.random.SeedSequence, bounds: tuple[float, float], size: int | tuple[int, ...]
) -> Float[np.ndarray, "*size"]:
    if bounds[0] == bounds[1]:
        return np.full(size, bounds[0])
    return np.random.Generator(np.random.Philox(seed)).uniform(*bounds, size)


def _within(bounds: tuple[float, float] | None, share: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    return np.ones_like(share) if bounds is None else bounds[0] + (bounds[1] - bounds[0]) * share


def _loads(
    config: DatasetConfig, device: Wire, velocity: Float[np.ndarray, "n samples 1 2"]
) -> Float[np.ndarray, "n samples 1 2"]:
    """Return the drive's loads (N, N·mm) that would move a free wire at these velocities, within the drive's limits."""
    fastest = DriveLimits.of(device).fastest
    return free_wire_load(
        np.clip(velocity, -fastest, fastest),
        radius_mm=device.tip_radius_mm,
        friction_n=config.simulator.introducer_friction_n,
        drag_n_s_mm=config.simulator.introducer_drag_n_s_mm,
        stick_mm_s=config.simulator.stick_velocity_mm_s,
    )


STOP_SHORT_MM = 5.0  # a tip is driven no nearer than this to the end of its branch, mm
PULL_BACK_MM = 15.0  # a wire at an end, or caught, is pulled back by this length before it is pushed again
CAUGHT = 0.5  # share of the device's push limit at which a wire counts as caught
_ROUNDING_MM = 1e-2  # a wire this near to its pull-back target counts as pulled back


def simulate_navigations(
    set_up: SimulationSetUp,
    control: Float[np.ndarray, "worlds samples devices 2"],
    *,
    robot: RobotConfig | None = None,
    seeds: Sequence[Sequence[int]] = (),
    ostium_mm: float = 0.0,
    record_shape: bool = False,
    advance: Callable[[int], None] = lambda samples: None,
) -> tuple[Trajectory, Bool[np.ndarray, "worlds"]]:
    """Simulate drawn navigations of one anatomy, and return them and which were stopped short of the vessel's ends. A
    robot's columns are what it was commanded (`decided`) and measured (`encoders`, `load`), its commands, float32, the
    mean of what its drives made of that; true lengths are `ostium_mm` more than its encoders', mm."""
    anatomy, stacks, actuation = set_up.anatomies[0], set_up.stacks, set_up.actuation
    watch = _PushRoom(anatomy.tree, stacks)
    simulator = Simulator(anatomy, stacks, actuation=actuation, motion=set_up.motion, config=set_up.config)
    _begin(simulator, watch, set_up.initial, set_up.friction)
    if record_shape:
        check_shape_memory(len(control), control.shape[1], simulator.nodes)
    recorder = Recorder(simulator, SAMPLE_PERIOD_S, record_shape=record_shape)
    stopped = np.zeros(len(control), dtype=bool)
    inserted = simulator.inserted_length
    last, slip = np.zeros_like(inserted), np.zeros_like(inserted)
    robots, measured = None, []
    if robot is not None:
        limits = [[DriveLimits.of(device, anatomy) for device in stack.devices] for stack in stacks]
        robots = Robots(simulator, robot, limits, seeds=seeds, ostium_mm=ostium_mm)
    for sample in range(control.shape[1]):
        drawn = control[:, sample, :, 0]
        caught = (slip > 0) | (simulator.base_load[..., 0] > watch.caught_n)
        # How far a load moves the wire is not known: about as far as the last one did.
        needed = last if actuation == "force" else np.zeros_like(last)
        room = watch.room(simulator.project(), inserted, needed, caught)
        held = np.where(room > 0, drawn, -np.abs(drawn))
        if actuation == "velocity":
            held = within_travel(np.minimum(held, room / SAMPLE_PERIOD_S), inserted, SAMPLE_PERIOD_S)
        stopped |= ((drawn > 0) & (held < drawn)).any(axis=1)
        commanded = np.stack([held, control[:, sample, :, 1]], axis=-1).astype(np.float32)
        if robots is None:
            step = recorder.step(commanded)
        else:
            robots.motion.command(commanded.astype(float))
            step, read = robots.drive(simulator, SAMPLE_PERIOD_S, recorder.step)
            measured.append(np.concatenate([commanded, read], axis=-1))
        slip, last, inserted = step.slip, step.inserted_length - inserted, step.inserted_length
        advance(len(control))
    trajectory = recorder.trajectory()
    if measured:
        columns = np.split(np.stack(measured, axis=1), 3, axis=-1)
        trajectory = replace(trajectory, columns=dict(zip(OF_ROBOT, columns, strict=True)))
    return trajectory, stopped


class _PushRoom:
    """How far each device (columns) may still be pushed in each world; over `caught_n` of push, N, it is caught."""

    def __init__(self, tree: VesselTree, stacks: Sequence[Stack]) -> None:
        self._ends = np.full(len(tree.branches), np.inf)  # of branches that go on
        for leaf in tree.leaves():
            self._ends[leaf] = tree.branches[leaf].centerline.abscissa[-1]
        self.deepest_mm = max(float(self._ends[np.isfinite(self._ends)].max()) - STOP_SHORT_MM, 0.0)
        self.caught_n = CAUGHT * np.array([[device.push_limit_n for device in stack.devices] for stack in stacks])
        self._limit = np.full(self.caught_n.shape, np.inf)

    def room(
        self,
        tip: TipProjection,
        inserted: Float[np.ndarray, "worlds devices"],
        needed: Float[np.ndarray, "worlds devices"],
        caught: Bool[np.ndarray, "worlds devices"],
    ) -> Float[np.ndarray, "worlds devices"]:
        """Return the advance (mm) that is left to each; 0 where it is `needed` or less, or until it is back."""
        ahead = np.minimum(self.deepest_mm - inserted, self.ahead(tip))
        stop = caught | (ahead <= np.maximum(needed, _ROUNDING_MM))
        back = np.maximum(inserted - PULL_BACK_MM, 0.0)
        self._limit = np.where(stop, np.minimum(self._limit, back), self._limit)
        is_back = ~stop & (inserted < self._limit + _ROUNDING_MM)
        self._limit = np.where(is_back, np.inf, self._limit)
        return np.where(np.isinf(self._limit), ahead, 0.0)

    def ahead(self, tip: TipProjection) -> Float[np.ndarray, "worlds devices"]:
        """Return how far each tip is from where it is stopped in its branch, mm; negative beyond."""
        return self._ends[tip.branch] - STOP_SHORT_MM - tip.abscissa


def _begin(
    simulator: Simulator,
    watch: _PushRoom,
    initial: Float[np.ndarray, "worlds devices 2"],
    friction: Float[np.ndarray, "worlds devices"],
) -> None:
    """Push the devices to their first inserted length, or as deep as they go freely."""
    start, turn, again = np.minimum(initial[..., 0], watch.deepest_mm), initial[..., 1], np.arange(len(initial))
    while len(again):
        simulator.reset(inserted_length=start, rotation=turn, friction=friction, worlds=again.tolist())
        inserted = simulator.inserted_length
        slipped = inserted != start  # a weakly driven device is also carried along by another one
        far = np.where(slipped, STOP_SHORT_MM, -watch.ahead(simulator.project()))
        bad = (slipped | (far > _ROUNDING_MM)) & (start > 0) & simulator.valid[:, None]
        again = np.flatnonzero(bad.any(axis=1))
        start[bad] = np.maximum(np.minimum(inserted, start)[bad] - np.maximum(far[bad], 1.0), 0.0)
