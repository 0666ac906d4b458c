"""What is real in an environment's worlds: vessels, devices, ostia, robots; some of it drawn in each episode."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from endopilot.belief.vessels import SharedVessels
from endopilot.devices.drive_limits import DriveLimits, within_travel
from endopilot.devices.robot import IDEAL, DriveConfig, RobotConfig, read_robot
from endopilot.errors import InputError
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.engine_simulator import ENGINES
from endopilot.simulation.motion import Motion
from endopilot.simulation.robots import Robots, backs_out_mm, in_grip
from endopilot.simulation.trajectory import Step
from endopilot.simulation.world import NOMINAL, World, read_world
from endopilot.tasks.navigation import Navigation

RANDOM = "random"
"""In place of a world or a robot: another one in each episode."""
_OSTIUM_MM, _REGISTERED_MM, _TIMES = 2.5, 1.0, 2.0
"""A random world's ostium and registration lie up to this far off, mm; friction is up to so many times more or less.
The shipped worlds differ as much."""
_PLAY_MM, _PLAY_RAD, _GAIN, _LATENCY_S = 2.6, 5.65, 0.05, 0.1
"""The largest plays of a random robot, mm and rad: the largest that were measured (docs/concepts/robot.md); the largest
difference of its gains from 1, and twice the latency that is assumed, s."""


def draw_world(random: np.random.Generator) -> World:
    """Return a random world, which differs in what may change between two episodes."""
    return World(
        friction_factor=float(_TIMES ** random.uniform(-1.0, 1.0)),
        ostium_mm=float(random.uniform(-_OSTIUM_MM, _OSTIUM_MM)),
        registration_mm=tuple(random.uniform(-_REGISTERED_MM, _REGISTERED_MM, 3).tolist()),
    )


def draw_robot(random: np.random.Generator) -> RobotConfig:
    """Return a random robot; its encoders sit at the motors or on the devices, as likely."""
    drive = DriveConfig(
        gain_translation=float(1 + random.uniform(-_GAIN, _GAIN)),
        gain_rotation=float(1 + random.uniform(-_GAIN, _GAIN)),
        play_mm=float(random.uniform(0.0, _PLAY_MM)),
        play_rad=float(random.uniform(0.0, _PLAY_RAD)),
    )
    at_motors, latency_s = random.random() < 0.5, float(random.uniform(0.0, _LATENCY_S))
    return RobotConfig(
        encoders_at="motor" if at_motors else "wire", latency_s=latency_s, wire=drive, catheters=(drive,)
    )


@dataclass(eq=False)
class Drawn:
    """What episodes begin with and go on with; a row a world.

    True inserted lengths are `ostium_mm` more than the encoders', and the guiding catheter has yet to back out by
    `backs_out_mm`. `readings` are what `robots` measured last; both are None where the devices do as commanded.
    """

    ostium_mm: Float[np.ndarray, "worlds"]
    registration_mm: Float[np.ndarray, "worlds 3"]
    backs_out_mm: Float[np.ndarray, "worlds"]
    robots: Robots | None = None
    readings: Float[np.ndarray, "worlds devices 4"] | None = None


class Reality:
    """The worlds of an environment as they truly are; `drawn` is what differs from episode to episode."""

    def __init__(
        self,
        navigations: Sequence[Navigation],
        *,
        world: World | str | Path | Sequence[World | str | Path] | None,
        robot: RobotConfig | str | Path | Sequence[RobotConfig | str | Path] | None,
        motion: Motion | None,
        config: SimulatorConfig,
    ) -> None:
        """Lay the devices out, each world as it is; the arguments are those of `NavigateVectorEnv`. InputError for no
        such world or robot, or worlds that differ in what all must have in common."""
        count = len(navigations)
        worlds = _spread(NOMINAL if world is None else world, count, read_world)
        self._worlds = [
            None if each is None else each.drawn(navigation.anatomy, number)
            for number, (each, navigation) in enumerate(zip(worlds, navigations, strict=True))
        ]
        fixed = [each or World() for each in self._worlds]
        engine = ENGINES[_common(fixed, "engine", [each.engine for each in fixed])]
        motion = _common(fixed, "motion", [each.motion or motion for each in fixed])
        config = _common(fixed, "core or wall", [each.core(config) for each in fixed])
        self._robots: list[RobotConfig | None] | None = None  # where devices do as commanded; None of one that is drawn
        if robot is not None or any(each.robot for each in fixed):
            self._robots = [
                None if own is None and each.robot is None else each.real_robot(own or RobotConfig())
                for each, own in zip(fixed, _spread(IDEAL if robot is None else robot, count, read_robot), strict=True)
            ]
        stacks = [each.stack(navigation.stack) for each, navigation in zip(fixed, navigations, strict=True)]
        if self._robots is not None:
            held = [in_grip(s, r or RobotConfig(), config) for s, r in zip(stacks, self._robots, strict=True)]
            stacks, (config, *others) = [stack for stack, _ in held], [core for _, core in held]
            if any(other != config for other in others):
                raise InputError(
                    "robot: its grip is weaker than devices of different push limits; give config a wall stiffness"
                )
        # the same differences, one vessel
        made = {id(each.anatomy): SharedVessels(each.anatomy) for each in navigations}
        vessels = [made[id(each.anatomy)].of(world) for each, world in zip(navigations, fixed, strict=True)]
        self.simulator = engine(vessels, stacks, motion=motion, config=config)
        self._friction = np.array([[device.friction for device in stack.devices] for stack in stacks])
        self._start = np.array([navigation.start for navigation in navigations])
        self._backs_out_s = np.array([each.backs_out_after_s for each in fixed])
        self.drawn = Drawn(
            ostium_mm=np.array([each.ostium_mm for each in fixed]),
            registration_mm=np.array([each.registration_mm for each in fixed], dtype=float),
            backs_out_mm=np.zeros(count),
        )
        limits = [[DriveLimits.of(device, each.anatomy) for device in each.devices] for each in navigations]
        self._far_ends = np.array([[drive.travel_mm[1] for drive in drives] for drives in limits])
        if self._robots is not None:
            random = [_OSTIUM_MM if each is None else each.ostium_mm for each in self._worlds]
            counted = [
                [each.by_encoder(deeper) if deeper else each for each in of]
                for of, deeper in zip(limits, random, strict=True)
            ]
            robots, seeds = [each or RobotConfig() for each in self._robots], [(world,) for world in range(count)]
            self.drawn.robots = Robots(self.simulator, robots, counted, seeds=seeds, ostium_mm=self.drawn.ostium_mm)
            self.drawn.readings = self.drawn.robots.read(self.simulator)

    @property
    def encoders(self) -> Float[np.ndarray, "worlds devices 2"]:
        """Δ, mm, and φ, rad, as the robots' encoders said last; without noise where there are no robots."""
        if self.drawn.readings is not None:
            return self.drawn.readings[..., :2]
        places = self.simulator.proximal
        places[..., 0] -= self.drawn.ostium_mm[:, None]
        return places

    @property
    def proximal(self) -> Float[np.ndarray, "worlds devices 4"]:
        """What is measured of the devices: `encoders`, and the drives' force, N, and torque, N·mm."""
        if self.drawn.readings is not None:
            return self.drawn.readings
        return np.concatenate([self.encoders, self.simulator.drive_load], axis=-1)

    def begin(self, mask: Bool[np.ndarray, "worlds"], generators: Sequence[np.random.Generator]) -> None:
        """Start an episode in the worlds of a mask: the wire's rotation is drawn, and what is random in them."""
        simulator, drawn, chosen = self.simulator, self.drawn, np.flatnonzero(mask).tolist()
        turn, friction = self._start[..., 1].copy(), self._friction.copy()
        begun: list[World] = []
        for world in chosen:
            turn[world, 0] = generators[world].uniform(0.0, 2 * np.pi)
            real = self._worlds[world] or draw_world(generators[world])
            friction[world] *= real.friction_factor if self._worlds[world] is None else 1.0
            drawn.ostium_mm[world], drawn.registration_mm[world] = real.ostium_mm, real.registration_mm
            drawn.backs_out_mm[world] = real.backs_out_mm
            begun.append(real)
        deep = np.maximum(self._start[..., 0] + drawn.ostium_mm[:, None], 0.0)
        simulator.reset(inserted_length=deep, rotation=turn, friction=friction, worlds=chosen)
        if drawn.robots is None or drawn.readings is None or self._robots is None:
            return
        seeds = [(int(generators[world].integers(2**62)),) for world in chosen]
        robots = [
            self._robots[world] or real.real_robot(draw_robot(generators[world]))
            for world, real in zip(chosen, begun, strict=True)
        ]
        drawn.robots.ostium_mm[chosen] = drawn.ostium_mm[chosen]
        drawn.robots.reset(simulator, chosen, seeds, robots)
        drawn.readings[mask] = drawn.robots.read(simulator, worlds=chosen)

    def drive(
        self, control: Float[np.ndarray, "worlds devices 2"], period_s: float, time_s: Float[np.ndarray, "worlds"]
    ) -> Step:
        """Move the devices for a while, by robots if there are some; `time_s` counts from each episode's start."""
        simulator, drawn = self.simulator, self.drawn
        due = time_s >= self._backs_out_s - period_s / 2
        back = backs_out_mm(simulator, due, drawn.backs_out_mm, period_s)
        drawn.backs_out_mm -= back
        if drawn.robots is None:
            travel_mm = (-np.inf, self._far_ends)  # it stops by itself at the ostium
            control[..., 0] = within_travel(control[..., 0], simulator.inserted_length, period_s, travel_mm=travel_mm)
            drawn.ostium_mm -= back
            control[..., 0] -= back[:, None] / period_s
            return simulator.step(control, period_s)
        drawn.robots.motion.command(control)
        moved = partial(simulator.step, duration_s=period_s)
        step, drawn.readings = drawn.robots.drive(simulator, period_s, moved, back)
        return step


def _spread(given: Any, count: int, read: Any) -> list[Any]:
    """Return of each world what is given for all, or for world i number i modulo how many are; None if it is drawn."""
    several = [given] if isinstance(given, (str, Path, World, RobotConfig)) else list(given)
    if not several:
        raise InputError("world, robot: an empty list; give at least one")
    made = [None if each == RANDOM else read(each) if isinstance(each, (str, Path)) else each for each in several]
    return [made[number % len(made)] for number in range(count)]


def _common(worlds: Sequence[World], names: str, values: Sequence[Any]) -> Any:
    if any(value != values[0] for value in values):
        raise InputError(
            f"world: worlds differ in {names}, which all in an environment have in common; give worlds that agree"
        )
    return values[0]
