"""A simulated wire as it would lie, turned to another side or moved along its vessel: `Fans`, `turned`, `shifted`."""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from endopilot.devices.stack import Stack
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.motion import Motion
from endopilot.simulation.simulator import Simulator
from endopilot.tasks.navigation import DECISION_PERIOD_S
from endopilot.types import Anatomy

_SIDES = 16
"""Angles that a wire is turned to where its rotation is looked for."""


class Fans:
    """Copies of a member of a belief, each turned by another angle; members of a kind share theirs."""

    def __init__(self, kinds: Sequence[tuple[Anatomy, Stack]], motion: Motion | None, config: SimulatorConfig) -> None:
        """Take what the members are simulated with."""
        self._kinds, self._motion, self._config = kinds, motion, config
        self._made = dict[int, Simulator]()

    def of(self, kind: int, member: int, simulator: Simulator) -> Simulator:
        """Return copies of a member as it lies now, those turned to more than half a turn backwards."""
        if kind not in self._made:
            anatomy, stack = self._kinds[kind]
            self._made[kind] = Simulator(
                anatomy, stack, worlds=_SIDES, motion=self._motion, config=self._config, sharing=[simulator]
            )
        fan, side = self._made[kind], 2 * np.pi * np.arange(_SIDES) / _SIDES
        fan.copy_worlds(np.full(_SIDES, member), of=simulator)
        turn = np.where(side > np.pi, side - 2 * np.pi, side)
        fastest = self._kinds[kind][1].wire.max_rotation_rad_s
        periods = int(np.ceil(np.pi / (fastest * DECISION_PERIOD_S)))
        control = np.zeros((_SIDES, fan.devices, 2))
        control[:, 0, 1] = turn / (periods * DECISION_PERIOD_S)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # one that fails stays where it was
            for _ in range(periods):
                fan.step(control, DECISION_PERIOD_S)
        return fan


def turned(
    simulator: Simulator, member: int, turn: Float[np.ndarray, "n"], fan: Simulator | None
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Return the end of a member's wire, turned by some angles, rad, and its direction there, LPS mm.

    Args:
        fan: its copies; where there are none, the wire is taken not to turn.
    """
    if fan is None:
        end, direction = simulator.tip_position[member, 0], simulator.tip_direction[member, 0]
        return np.tile(end, (len(turn), 1)), np.tile(direction, (len(turn), 1))
    ends, directions = fan.tip_position[:, 0], fan.tip_direction[:, 0]
    place = (turn % (2 * np.pi)) * _SIDES / (2 * np.pi)
    low = place.astype(int) % _SIDES
    share = (place % 1.0)[:, None]
    mixed = [(1 - share) * each[low] + share * each[(low + 1) % _SIDES] for each in (ends, directions)]
    return mixed[0], mixed[1] / np.maximum(np.linalg.norm(mixed[1], axis=1, keepdims=True), 1e-9)


def shifted(
    anatomy: Anatomy, branch: int, abscissa_mm: float, along_mm: Float[np.ndarray, "n"]
) -> Float[np.ndarray, "n 3"]:
    """Return how far a tip moves, mm, that goes some way along the vessel, mm, from a place on a branch."""
    line, insertion = anatomy.tree.path(branch), anatomy.insertion
    behind = np.array([-20.0, -10.0])
    abscissa = np.concatenate([behind, line.abscissa])
    points = np.concatenate([insertion.position + behind[:, None] * insertion.direction, line.points])
    there, here = (
        np.column_stack([np.interp(x, abscissa, axis) for axis in points.T])
        for x in (abscissa_mm + along_mm, np.array([abscissa_mm]))
    )
    return there - here
