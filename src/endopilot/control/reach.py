"""What a wire's tip can reach at the forks of a route: in closed form, and tested in the rod core.

A tip that is bent by θ over a length L stands L(1 − cos θ)/θ beside the wire behind it: its *lateral reach*. A fork's
*free width* is what the lumen leaves the wire's axis to move in, 2r − d. A tip whose reach is as large enters every
branch of the fork, on whichever side the wire lies. One with less may, if the wire lies well: `rotations_that_enter`
asks the rod core, by pushing the wire on from the fork with its tip turned to all sides.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from endopilot.control.route import Route
from endopilot.simulation.config import PRESETS, SimulatorConfig
from endopilot.simulation.device import Device
from endopilot.simulation.drive_limits import DriveLimits
from endopilot.simulation.simulator import Simulator
from endopilot.tasks.navigation import DECISION_PERIOD_S, Navigation

ROTATIONS = 24
"""Rotations of the wire that are tried at a fork, evenly over a full turn."""
_LEAD_MM, _LEAD_RADII = 4.0, 1.4
"""The wire is turned this far before a fork, mm, or lumen radii where that is more."""
_SPEED_MM_S = 10.0
_PERIODS = 8
"""Decision periods in which a wire that is pushed on from a fork must have entered a branch."""


@dataclass(frozen=True)
class Fork:
    """A place of a route where branches part.

    Attributes:
        abscissa: Δtip of the branching point, mm.
        branch: index of the branch that the route takes.
        section: name of the section that this branch begins with.
        width_mm: free width of the lumen there for the wire's axis, 2r − d, mm.
    """

    abscissa: float
    branch: int
    section: str
    width_mm: float

    def __str__(self) -> str:
        return f"the fork into section {self.section} (branch {self.branch}) at {self.abscissa:.1f} mm"


def lateral_reach(bend_rad: float, length_mm: float) -> float:
    """Return how far a tip stands beside the wire behind it, mm: L(1 − cos θ)/θ.

    A tip that is bent by more than half a turn stands farthest beside the wire where it has turned by half of one.

    Args:
        bend_rad: angle by which it is bent, rad.
        length_mm: length over which it is bent, with constant curvature, mm.
    """
    angle = abs(bend_rad)
    return float(length_mm * (1 - np.cos(min(angle, np.pi))) / angle) if angle > 0 else 0.0


def forks(route: Route, device: Device) -> tuple[Fork, ...]:
    """Return the forks of a route, the nearest to the ostium first."""
    tree = route.anatomy.tree
    found = []
    for abscissa, branch in zip(route.junctions.tolist(), route.branches[1:], strict=False):
        own = tree.branches[branch].section
        radius = float(route.radius(np.array([abscissa]))[0])
        section = tree.section_names[int(own[min(1, len(own) - 1)])]
        found.append(Fork(abscissa, branch, section, 2 * radius - device.diameter_mm))
    return tuple(found)


def rotations_that_enter(navigation: Navigation, devices: Sequence[Device]) -> Int[np.ndarray, "devices forks"]:
    """Return with how many of `ROTATIONS` rotations each wire enters the right branch at each fork of the route.

    A wire is brought up to the fork, turned there and pushed on straight. From a fork that it enters it goes on with
    the rotation in the middle of those that do; at forks behind one that it does not enter, the number is 0. A rotation
    that presses on the wall with more than the navigation's force limit does not count.

    Args:
        navigation: vessel, target, start and force limit; its own device does not matter.
        devices: the wires, all of the same diameter.
    """
    route = Route.to(navigation.anatomy, navigation.target)
    places = forks(route, devices[0])
    wires = [device for device in devices for _ in range(ROTATIONS)]
    test = _Test(Simulator(navigation.anatomy, wires, config=_CORE), navigation, route, wires)
    count = np.zeros((len(devices), len(places)), dtype=int)
    going = np.ones(len(devices), dtype=bool)
    for index, fork in enumerate(places):
        entered = test.enter(fork, route.waypoints[index]).reshape(len(devices), ROTATIONS)
        count[:, index] = np.where(going, entered.sum(axis=1), 0)
        going &= count[:, index] > 0
        if not going.any():
            break
        test.go_on(np.array([_middle(row) for row in entered]))
    return count


_CORE: SimulatorConfig = PRESETS["fast"]


class _Test:
    """The wires of a test, `ROTATIONS` for each device."""

    def __init__(self, simulator: Simulator, navigation: Navigation, route: Route, wires: list[Device]) -> None:
        self._simulator, self._route, self._wires = simulator, route, wires
        self._limit = navigation.force_limit_n
        self._travel = DriveLimits.of(wires[0], navigation.anatomy)
        count = simulator.worlds
        simulator.reset(
            inserted_length=np.full(count, navigation.start_inserted_mm),
            rotation=np.full(count, navigation.start_rotation),
        )

    def enter(self, fork: Fork, waypoint: float) -> Bool[np.ndarray, "worlds"]:
        """Bring all wires up to a fork, turn them to all sides, push them on; return which enter the right branch."""
        radius = float(self._route.radius(np.array([fork.abscissa]))[0])
        begin = max(fork.abscissa - max(_LEAD_MM, _LEAD_RADII * radius), 0.0)
        for _ in range(int(np.ceil(fork.abscissa / (_SPEED_MM_S * DECISION_PERIOD_S))) + _PERIODS):
            here = self._route.progress(self._simulator.project())
            speed = np.clip((begin - here) / DECISION_PERIOD_S, -_SPEED_MM_S, _SPEED_MM_S)
            if (np.abs(speed) < 1.0).all():
                break
            self._drive(np.where(np.abs(speed) < 1.0, 0.0, speed), 0.0)
        side = np.tile(np.arange(ROTATIONS) / ROTATIONS - 0.5, len(self._wires) // ROTATIONS)
        for _ in range(2):
            self._drive(0.0, np.pi * side / DECISION_PERIOD_S)
        entered, gone = np.zeros(len(side), dtype=bool), np.zeros(len(side), dtype=bool)
        for _ in range(_PERIODS):
            pressed = self._drive(np.where(entered | gone, 0.0, _SPEED_MM_S), 0.0)
            tip = self._simulator.project()
            gone |= pressed | (self._route.off_route(tip) > 2 * radius)
            entered |= ~gone & self._passed(waypoint)
            if (entered | gone).all():
                break
        return entered

    def _passed(self, waypoint: float) -> Bool[np.ndarray, "worlds"]:
        tip = self._simulator.project()
        return (self._route.off_route(tip) == 0) & (tip.abscissa >= waypoint)

    def go_on(self, chosen: Int[np.ndarray, "devices"]) -> None:
        """Put all wires of a device where one of them is."""
        first = ROTATIONS * np.arange(len(chosen))
        self._simulator.copy_worlds(np.repeat(first + chosen, ROTATIONS))

    def _drive(
        self, speed: float | Float[np.ndarray, "worlds"], turn: float | Float[np.ndarray, "worlds"]
    ) -> Bool[np.ndarray, "worlds"]:
        """Drive all wires for a decision period; return which press too hard or failed."""
        control = np.zeros((self._simulator.worlds, 2))
        control[:, 0], control[:, 1] = speed, turn
        control = self._travel.clip(control, self._simulator.inserted_length, DECISION_PERIOD_S)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a wire that fails has not entered
            step = self._simulator.step(control, DECISION_PERIOD_S)
        return (step.contact_force_max > self._limit) | ~step.valid


def _middle(entered: Bool[np.ndarray, "rotations"]) -> int:
    """Return the rotation in the middle of the longest run of those that enter, counted around the full turn."""
    if entered.all() or not entered.any():
        return 0
    twice = np.concatenate([entered, entered])
    length = np.zeros(len(twice), dtype=int)
    for index in range(len(twice)):
        length[index] = length[index - 1] + 1 if twice[index] and index else int(twice[index])
    end = int(np.argmax(length))
    return (end - int(length[end]) // 2) % len(entered)
