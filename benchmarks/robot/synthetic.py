"""Logs of the house's simulated robot, whose constants are known, as a laboratory would write them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float

from endopilot.devices.device import Wire
from endopilot.devices.drive_limits import DriveLimits
from endopilot.devices.robot import RobotConfig
from endopilot.robot.log import RobotLog
from endopilot.robot.robot import SimulatedRobot
from endopilot.simulation.config import PRESETS
from endopilot.simulation.simulator import Simulator
from endopilot.types import Anatomy

PERIOD_S, TIP_SD_MM = 0.1, 0.05
"""Time between commands, s, and standard deviation of the tips that are seen, mm."""


def logged(
    anatomy: Anatomy, wire: Wire, robot: RobotConfig, *, episodes: int = 6, seconds: float = 12.0, seed: int = 0
) -> RobotLog:
    """Drive a wire to and fro at random, and log commands, loads and tips; each episode begins anew."""
    return logged_and_true(anatomy, wire, robot, episodes=episodes, seconds=seconds, seed=seed)[0]


def logged_and_true(
    anatomy: Anatomy, wire: Wire, robot: RobotConfig, *, episodes: int, seconds: float, seed: int
) -> tuple[RobotLog, Float[np.ndarray, "periods 2"]]:
    """Return also where the wire's proximal end truly was at the end of each period, mm and rad."""
    random, rows, truth = np.random.default_rng(seed), [], []
    far = float(anatomy.tree.longest_path().abscissa[-1])
    for episode in range(episodes):
        simulator = Simulator(anatomy, wire, config=PRESETS["fast"])
        depth = random.uniform(6.0, 10.0)
        simulator.reset(inserted_length=[depth], rotation=[random.uniform(0, 2 * np.pi)])
        limits = DriveLimits(max_velocity_mm_s=20.0, max_rotation_rad_s=6.0, travel_mm=(0.0, far))
        drive = SimulatedRobot(simulator, [limits], robot, seed=seed + episode)
        at, velocity = depth, np.zeros(2)
        for k in range(round(seconds / PERIOD_S)):
            if k % 10 == 0:  # a manoeuvre takes a second
                velocity = np.array([random.uniform(-6, 8), random.uniform(-2, 2)])
            if not 3.0 < at + velocity[0] < far - 8.0:
                velocity[0] = -velocity[0]
            at += velocity[0] * PERIOD_S
            drive.command(((velocity[0], velocity[1]),))
            drive.run(PERIOD_S)
            tip = simulator.tip_position[0, 0] + TIP_SD_MM * random.standard_normal(3)
            truth.append(drive.proximal[0].copy())
            state = drive.proximal_state()
            rows.append((episode, k * PERIOD_S, velocity.copy(), tip, state.devices[0], state.load[0]))
    return log_of(rows), np.array(truth)


def log_of(rows: Sequence[tuple[Any, ...]], *, period_s: float = PERIOD_S, by_velocity: bool = True) -> RobotLog:
    """Return two rows for each period: the command at its start, tip, encoders and load at its end.

    Args:
        rows: of each period its episode, time, s, velocity, mm/s and rad/s, and tip, encoders and load at its end.
        period_s: between commands, s.
        by_velocity: whether velocities are logged, or the positions that they lead to.
    """
    count = 2 * len(rows)
    nothing = np.full((count, 1, 2), np.nan)
    log = RobotLog(
        name="synthetic",
        time_s=np.zeros(count),
        episode=np.zeros(count, dtype=np.int64),
        command=nothing.copy(),
        encoders=nothing.copy(),
        load=nothing.copy(),
        tip=np.full((count, 3), np.nan),
        pixel=np.full((count, 2), np.nan),
        used=np.ones(count, dtype=bool),
        by_velocity=by_velocity,
    )
    place = np.zeros(2)
    for k, (episode, time_s, velocity, tip, encoders, load) in enumerate(rows):
        place = velocity * period_s + (place if k and rows[k - 1][0] == episode else 0.0)
        began = 100.0 * episode + time_s
        log.time_s[2 * k : 2 * k + 2] = began, began + period_s - 1e-6
        log.episode[2 * k : 2 * k + 2] = episode
        log.command[2 * k, 0] = place
        log.tip[2 * k + 1], log.encoders[2 * k + 1, 0], log.load[2 * k + 1, 0] = tip, encoders, load
    return log


def drawn(seed: int) -> RobotConfig:
    """Draw a robot: gain, play and lag, with encoders before the play."""
    random = np.random.default_rng([seed, 7])
    robot = RobotConfig(encoders_at="motor", latency_s=float(random.uniform(0.05, 0.3)))
    drive = replace(
        robot.wire,
        gain_translation=float(random.uniform(0.9, 1.1)),
        play_mm=float(random.uniform(0.5, 3.0)),
        play_rad=float(random.uniform(0.0, 2.0)),
    )
    return replace(robot, wire=drive)
