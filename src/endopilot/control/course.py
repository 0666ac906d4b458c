"""What a search finds, `Course`, the places of a route that it passes, and how drives follow it: `Follower`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from endopilot.belief.drives import Drives
from endopilot.devices.stack import Proximals
from endopilot.tasks.navigation import DECISION_PERIOD_S
from endopilot.tasks.route import ENTERED_MM, Route
from endopilot.types import TipProjection

Controls = Float[np.ndarray, "periods devices 2"]
"""Translation (mm/s) and rotation (rad/s) of each device in each decision period."""


@dataclass(frozen=True, eq=False)
class Course:
    """Controls, and what the wires that they were found with do under them.

    Attributes:
        control: (mm/s, rad/s) of each device in each decision period.
        proximal: inserted length (mm) and rotation (rad) of each device at the end of each period, as encoders tell.
        tip: of the wires then, a column a wire; those that the course leaves behind are not among them.
        force: largest wall force on a node, N, of all wires.
        checked: whether a wire that is elsewhere then has left the course.
        exposed: whether X-ray is to show where a manoeuvre has led.
        reached: whether they end at the target, by weight: 1 if all do.
    """

    control: Controls
    proximal: Controls
    tip: TipProjection
    force: Float[np.ndarray, "periods wires"]
    checked: Bool[np.ndarray, "periods"]
    exposed: Bool[np.ndarray, "periods"]
    reached: float


_STRETCH_MM, _LONG_STRETCH_MM = 20.0, 40.0
"""Devices pass the route in stretches of this length at most, mm: of the former where wire and catheter move in turn,
of the latter else. What is hard is tried from near by then, and what is before it is driven while the search goes on.
"""


def places_of(route: Route, begun: float, *, alone: bool, together: bool) -> list[float]:
    """Return the places that are passed, mm, from where devices have come to: waypoints, and others between."""
    longest = _LONG_STRETCH_MM if together or alone else _STRETCH_MM
    places: list[float] = []
    ahead = route.waypoints[:-1] > begun - alone * ENTERED_MM
    for goal in [*route.waypoints[:-1][ahead].tolist(), route.target.abscissa]:
        begin = places[-1] if places else begun
        count = max(1, int(np.ceil((goal - begin) / longest)))
        places += [begin + (goal - begin) * (k + 1) / count for k in range(count - 1)] + [goal]
    return places


_UNSURE_RAD = 0.3
"""A rotation that is known no better is looked at before a wire is pushed or pulled, rad."""
_OFF_RAD = 0.25
"""A wire that is turned otherwise than its course by more than this is turned before it goes on, rad."""
_LOOKS, _SETTLES = 2, 6
"""Times that a wire is looked at after it was turned, and periods that it is turned for at one place of a course."""
_TURNED_RAD_S = 0.1
"""A wire whose drive turned no faster was not turned, rad/s."""
_STILL = 1e-3
"""A device that moves no faster does not move, mm/s or rad/s."""


class Follower:
    """Leads devices along a course by drives that may lose motion.

    A course says where the proximal ends are to be, not what encoders read. Where play lies between the two, a device
    that turns back rests until its play is taken up; only then does the course go on. A wire whose rotation is no
    longer known is looked at, and turned to where the course has it, before it is pushed on.

    Attributes:
        course: that is followed; None if there is none.
        at: its period that comes next.
        shows: whether X-ray is to show where the last step has led.
    """

    def __init__(self, drives: Drives, *, devices: int, turn_rad_s: float) -> None:
        """Follow nothing yet, by drives as they are believed to be, which take up play at `turn_rad_s` at most."""
        self._drives, self._devices, self._fastest = drives, devices, np.array([np.inf, turn_rad_s])
        self._looked, self.shows = 0, False
        self.begin(None)

    def begin(self, course: Course | None) -> None:
        """Follow a course from its begin on, or none."""
        self.course, self.at, self._settled = course, 0, 0
        self._whole_turns = np.zeros((self._devices, 2))

    def extend(self, course: Course) -> None:
        """Follow a course that begins as the one which is followed does, and goes on from its end."""
        self.course = course

    @property
    def ended(self) -> bool:
        """Whether there is no course, or no more of it."""
        return self.course is None or self.at >= len(self.course.control)

    @property
    def reached(self) -> bool:
        """Whether there is a course that ends at the target."""
        return self.course is not None and self.course.reached > 0.5

    def move(self, speed_mm_s: list[float]) -> Proximals:
        """Return the velocities of drives by which devices move at some speeds, once their plays are taken up."""
        if not self._drives.lose:
            return tuple((speed, 0.0) for speed in speed_mm_s)
        wanted = self._drives.at_rest.copy()
        wanted[: len(speed_mm_s), 0] += DECISION_PERIOD_S * np.array(speed_mm_s)
        return self._drives.towards(wanted, self._fastest).commands

    def step(self) -> Proximals:
        """Return the velocities that lead to the next place of the course, or to the last one if the wire is not there.

        Raises:
            ValueError: there is no more of the course.
        """
        if self.course is None or self.ended:
            raise ValueError("the course has ended")
        self.shows = False
        course, drives, at = self.course, self._drives, self.at
        wanted = course.proximal[at]
        if drives.lose:
            held = self._settle(course)
            if held is not None:
                return held
            at = self._end_of_turn(course)
            wanted = course.proximal[at] + self._whole_turns
            unturned = (np.abs(course.control[at, :, 1]) < _STILL) & (at == self.at)
            wanted[:, 1] = np.where(unturned, drives.at_rest[:, 1], wanted[:, 1])  # off by less than `_OFF_RAD`
        motion = drives.towards(wanted, self._fastest)
        if motion.done:
            self.shows, self.at, self._settled = bool(course.exposed[at]), at + 1, 0
            if np.abs(motion.velocity[0, 1]) > _TURNED_RAD_S:
                self._looked = 0
        return motion.commands

    def _end_of_turn(self, course: Course) -> int:
        """Return the last of the periods in which devices only turn, which they do the shorter way, or the next."""
        still = np.abs(course.control[self.at :, :, 0]).max(axis=1) < _STILL
        if not still[0]:
            return self.at
        at = self.at + (len(still) if still.all() else int(np.argmin(still))) - 1
        turn = course.proximal[at, :, 1] + self._whole_turns[:, 1]
        self._whole_turns[:, 1] += self._drives.nearest_turn(turn) - turn
        return at

    def _settle(self, course: Course) -> Proximals | None:
        """Return velocities by which the wire rests to be looked at, or is turned; None where it may go on."""
        at, drives = self.at, self._drives
        if np.abs(course.control[at, :, 0]).max() < _STILL:
            return None
        if drives.sd[0, 1] > _UNSURE_RAD and self._looked < _LOOKS:
            self._looked, self.shows = self._looked + 1, True
            return ((0.0, 0.0),)
        turn = course.proximal[at, 0, 1] - DECISION_PERIOD_S * course.control[at, 0, 1] + self._whole_turns[0, 1]
        if abs(turn - drives.at_rest[0, 1]) <= _OFF_RAD or self._settled >= _SETTLES:
            return None
        wanted = drives.at_rest.copy()
        wanted[0, 1] = turn
        nearest = drives.nearest_turn(wanted[:, 1])
        self._whole_turns[:, 1] += nearest - wanted[:, 1]
        wanted[:, 1] = nearest
        self._settled, self._looked = self._settled + 1, 0
        return drives.towards(wanted, self._fastest).commands
