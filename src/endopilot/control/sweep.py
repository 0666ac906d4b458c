"""A sweep of rotations: the wire is turned to all sides where it is, and pushed on with each; `sweep`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from endopilot.control.course import SLIP_SHARE, STALL_PERIODS, STALL_SHARE
from endopilot.control.period import drive_period
from endopilot.devices.drive_limits import DriveLimits
from endopilot.simulation.simulator import Simulator
from endopilot.tasks.navigation import DECISION_PERIOD_S
from endopilot.tasks.route import Route

Motion = Float[np.ndarray, "periods 2"]
"""(mm/s, rad/s) of a wire in each decision period."""
TURN_PERIODS = 2
"""Decision periods in which the wire is turned, half a turn at most."""
_OFF_MM = 4.0
"""A tip that is this far in a wrong branch does not come back, mm: in a wide fork it may seem to leave the route."""

_BEYOND_MM = 4.0
"""Wires of which some are this far beyond a waypoint, in the mean, and others before it, will not pass it together."""


@dataclass(frozen=True, eq=False)
class Sweep:
    """What became of the rotations of a sweep.

    Attributes:
        control: (mm/s, rad/s) of each decision period.
        periods: decision periods until a rotation passed the waypoint or was given up.
        passed: which rotations bring all wires that count past the waypoint.
        force: largest wall force on a node of any wire that counts, N.
        farthest: how far along the route each came, mm, the mean over the wires.
    """

    control: Float[np.ndarray, "periods rotations 2"]
    periods: Int[np.ndarray, "rotations"]
    passed: Bool[np.ndarray, "rotations"]
    force: Float[np.ndarray, "rotations"]
    farthest: Float[np.ndarray, "rotations"]

    def within(self, force_n: float) -> Bool[np.ndarray, "rotations"]:
        """Return which rotations pass without pressing on the wall with more than some force, N."""
        return self.passed & (self.force <= force_n)

    def controls(self, rotation: int) -> Motion:
        """Return the controls of one rotation."""
        return self.control[: self.periods[rotation], rotation]


def sweep(
    simulator: Simulator,
    route: Route,
    waypoint: float,
    *,
    weight: Float[np.ndarray, "wires"],
    travel: DriveLimits,
    force_limit_n: float,
    speed_mm_s: float,
    periods: int,
) -> Sweep:
    """Turn wires to all sides, push them on straight, and tell with which rotations they pass a waypoint.

    A rotation is given up where a wire leaves the route, stops though it is pushed, presses too hard, or fails, or
    the drive slips.

    Args:
        simulator: worlds of the wires, the same number of each, those of one wire side by side and in one state.
        route: to the target.
        waypoint: abscissa that is to be passed, mm; the target's own ends the sweep there.
        weight: how much each wire counts; those of 0 go along.
        travel: what the drive can do.
        force_limit_n: force on a node at which a rotation is given up, N.
        speed_mm_s: of the advance, mm/s.
        periods: decision periods that a sweep takes at most.
    """
    wires = len(weight)
    count, counted = simulator.worlds // wires, weight > 0
    last = waypoint >= route.target.abscissa
    side = 2 * np.pi * (np.arange(count) / count - 0.5)
    made: list[np.ndarray] = []
    passed, going = np.zeros(count, dtype=bool), np.ones(count, dtype=bool)
    took, force = np.zeros(count, dtype=int), np.zeros(count)
    progress = [_progress(simulator, route, wires)]
    for period in range(periods):
        control = np.zeros((count, 2))
        if period < TURN_PERIODS:
            control[:, 1] = side / (TURN_PERIODS * DECISION_PERIOD_S)
        else:
            left = (waypoint - weight @ progress[-1]) / DECISION_PERIOD_S
            control[:, 0] = np.where(going, np.clip(left, 1.0, speed_mm_s) if last else speed_mm_s, 0.0)
        inserted = simulator.inserted_length[:, 0].reshape(wires, count)
        for length in (inserted.min(axis=0), inserted.max(axis=0)):
            control = travel.clip(control, length, DECISION_PERIOD_S)
        step = drive_period(simulator, np.tile(control, (wires, 1)))
        made.append(control)
        took[going] = period + 1
        tip, shape = simulator.project()[:, 0], (wires, count)
        advance = simulator.inserted_length[:, 0].reshape(shape) - inserted
        slipped = advance < SLIP_SHARE * control[:, 0] * DECISION_PERIOD_S
        pressed = step.contact_force_max.reshape(shape)
        force = np.where(going, np.maximum(force, pressed[counted].max(axis=0)), force)
        progress.append(_progress(simulator, route, wires))
        if period >= TURN_PERIODS:
            off = route.off_route(tip).reshape(shape)
            there = (off == 0) & route.passed(tip, waypoint).reshape(shape)
            sound = step.valid.reshape(shape) & (pressed <= force_limit_n) & (off <= _OFF_MM) & ~slipped
            passed |= going & (sound & there)[counted].all(axis=0)
            going &= sound[counted].all(axis=0) & ~passed & (weight @ progress[-1] < waypoint + _BEYOND_MM)
        if period >= TURN_PERIODS + STALL_PERIODS - 1:
            going &= ~_stalled(made, progress, counted)
        if not going.any():
            break
    return Sweep(
        np.array(made).reshape(-1, count, 2), took, passed, force, np.max([weight @ row for row in progress], axis=0)
    )


def middle(passed: Bool[np.ndarray, "rotations"]) -> int:
    """Return the rotation in the middle of the longest run of those that pass, counted around the full turn."""
    if passed.all() or not passed.any():
        return 0
    twice = np.concatenate([passed, passed])
    length = np.zeros(len(twice), dtype=int)
    for index in np.flatnonzero(twice):
        length[index] = 1 + (length[index - 1] if index else 0)
    end = int(np.argmax(length))
    return (end - int(length[end]) // 2) % len(passed)


def _progress(simulator: Simulator, route: Route, wires: int) -> Float[np.ndarray, "wires rotations"]:
    return route.progress(simulator.project()[:, 0]).reshape(wires, -1)


def _stalled(
    made: list[np.ndarray], progress: list[np.ndarray], counted: Bool[np.ndarray, "wires"]
) -> Bool[np.ndarray, "rotations"]:
    """Return with which rotations a tip has stayed behind in the last periods while its wire went forward."""
    advance = np.sum([control[:, 0] for control in made[-STALL_PERIODS:]], axis=0) * DECISION_PERIOD_S
    gain = (progress[-1] - progress[-1 - STALL_PERIODS])[counted].min(axis=0)
    return (np.array(advance) > 2.0) & (gain < STALL_SHARE * advance)
