"""Copies of simulated devices, turned to all sides, or moved until one lies as X-ray shows it (`MovedCopies`).

Soft devices lie otherwise after they were pushed and pulled, though their drives are where they were: what lies in
loops comes out elsewhere. So copies whose drives go somewhere and come back lie in many of the ways in which the real
devices may.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float

from endopilot.devices.drive_limits import DriveLimits
from endopilot.lines import places_on
from endopilot.simulation.simulator import Simulator
from endopilot.tasks.navigation import DECISION_PERIOD_S
from endopilot.types import Anatomy

SIDES = 16
"""Angles that a wire is turned to where its rotation is looked for."""


def turn_to_all_sides(fan: Simulator, member: int, of: Simulator) -> None:
    """Make `SIDES` worlds copies of a member as it lies now, each turned by another angle as fast as its drive may:
    those to more than half a turn backwards."""
    fan.copy_worlds(np.full(SIDES, member), of=of)
    side = 2 * np.pi * np.arange(SIDES) / SIDES
    turn = np.where(side > np.pi, side - 2 * np.pi, side)
    fastest = fan.set_up.stacks[0].wire.max_rotation_rad_s
    periods = int(np.ceil(np.pi / (fastest * DECISION_PERIOD_S)))
    control = np.zeros((SIDES, fan.devices, 2))
    control[:, 0, 1] = turn / (periods * DECISION_PERIOD_S)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # one that fails stays where it was
        for _ in range(periods):
            fan.step(control, DECISION_PERIOD_S)


def shifted(
    anatomy: Anatomy, branch: int, abscissa_mm: float, along_mm: Float[np.ndarray, "n"]
) -> Float[np.ndarray, "n 3"]:
    """Return how far a tip moves, mm, that goes some way along the vessel, mm, from a place on a branch."""
    line, insertion = anatomy.tree.path(branch), anatomy.insertion
    behind = np.array([-20.0, -10.0])
    abscissa = np.concatenate([behind, line.abscissa])
    points = np.concatenate([insertion.position + behind[:, None] * insertion.direction, line.points])
    here = places_on(points, abscissa, np.array([abscissa_mm]))
    return places_on(points, abscissa, abscissa_mm + along_mm) - here


_ROUNDS, _PERIODS = 4, 3
"""Rounds, each from the nearest copy of the last, and decision periods that drives go away in each and come back."""
_NEAR_ENOUGH = 0.5
"""Misfit below which no further round is needed."""
_TURN_RAD_S = np.pi / 2
"""Speed at which copies are turned at most, rad/s."""
_REST_SHARE = 0.4
"""Share of the copies in which a catheter rests."""

Misfit = Callable[[Simulator], Float[np.ndarray, "worlds"]]
"""How far the devices of each world are from what X-ray shows: 1 where it just explains them."""


class MovedCopies:
    """Copies of a belief's likeliest devices.

    Attributes:
        at: the one that was found nearest to what X-ray shows.
    """

    def __init__(self, simulator: Simulator, limits: Sequence[DriveLimits]) -> None:
        """Take a simulator of as many worlds as there are to be copies, and the limits of each device's drive."""
        self.simulator, self._limits = simulator, list(limits)
        self._random, self.at = np.random.default_rng(0xC0B1), 0

    def seek(self, member: int, of: Simulator, misfit: Misfit) -> float:
        """Move copies of a member to and fro; return how near the nearest comes, `at`."""
        copies, count = self.simulator, self.simulator.worlds
        copies.copy_worlds(np.full(count, member), of=of)
        best = np.inf
        for number in range(_ROUNDS):
            control = self._draw()
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # one that fails is not chosen
                for direction in (1.0, -1.0):
                    for _ in range(_PERIODS):
                        copies.step(direction * control, DECISION_PERIOD_S)
            found = np.where(copies.valid, misfit(copies), np.inf)
            self.at = int(np.argmin(found))
            best = float(found[self.at])
            if best <= _NEAR_ENOUGH:
                break
            if number < _ROUNDS - 1:
                copies.copy_worlds(np.full(count, self.at))
        return best

    def _draw(self) -> Float[np.ndarray, "copies devices 2"]:
        """Draw a control for each copy: the next ones go ever farther, and the first stays where it is."""
        random, (count, devices) = self._random, (self.simulator.worlds, self.simulator.devices)
        share, drawn = np.arange(count)[:, None, None] / count, random.uniform(-1.0, 1.0, (count, devices, 2))
        control = share * drawn * [limits.fastest for limits in self._limits]
        control[:, 1:] *= random.random((count, devices - 1, 1)) > _REST_SHARE
        control[..., 1] = np.clip(control[..., 1], -_TURN_RAD_S, _TURN_RAD_S)
        lengths = self.simulator.at_drive[..., 0]
        for device, limits in enumerate(self._limits):
            control[:, device] = limits.clip(control[:, device], lengths[:, device], _PERIODS * DECISION_PERIOD_S)
        return control


def turned(
    simulator: Simulator, member: int, turn: Float[np.ndarray, "n"], fan: Simulator | None
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Return the end of a member's wire, turned by some angles, rad, and its direction there, LPS mm.

    Args:
        simulator: of all members.
        member: its place there.
        turn: the angles.
        fan: its copies; where there are none, the wire is taken not to turn.
    """
    if fan is None:
        end, direction = simulator.tip_position[member, 0], simulator.tip_direction[member, 0]
        return np.tile(end, (len(turn), 1)), np.tile(direction, (len(turn), 1))
    ends, directions = fan.tip_position[:, 0], fan.tip_direction[:, 0]
    place = (turn % (2 * np.pi)) * SIDES / (2 * np.pi)
    low = place.astype(int) % SIDES
    share = (place % 1.0)[:, None]
    mixed = [(1 - share) * each[low] + share * each[(low + 1) % SIDES] for each in (ends, directions)]
    return mixed[0], mixed[1] / np.maximum(np.linalg.norm(mixed[1], axis=1, keepdims=True), 1e-9)
