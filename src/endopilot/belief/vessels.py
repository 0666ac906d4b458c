"""The vessels and devices that members of a belief have: `SharedVessels`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Int

from endopilot.belief.thought import Budget
from endopilot.devices.stack import Stack
from endopilot.simulation.simulator import Simulator
from endopilot.simulation.world import World
from endopilot.types import Anatomy

_OF_VESSEL = "lumen_factor", "lumen_mm", "occluded", "stenosis", "axis_deg", "axis_side_deg", "ostium_aside_mm"
"""What of a `World` makes another vessel."""
_POINT = 0.3
"""Evaluations of nodes that take as long as another lumen takes for a point of its distance map, 35 ns."""


class SharedVessels:
    """The vessels of a navigation, with one lumen and another, which beliefs share: preparing one takes a second.

    Attributes:
        simulators: in which they are prepared.
    """

    def __init__(self, given: Anatomy) -> None:
        self._made = {World(): given}
        self.simulators: list[Simulator] = []
        self._kept = set[tuple[int, float]]()

    def of(self, member: World, budget: Budget | None = None) -> Anatomy:
        """Return the vessel as a member has it; making it is taken off a budget."""
        alone = World(**{name: getattr(member, name) for name in _OF_VESSEL})
        if alone not in self._made:
            self._made[alone] = made = alone.anatomy(self._made[World()])
            if budget is not None:
                budget.spend(_POINT * made.distance_map.values.size)
        return self._made[alone]

    def prepared(self, simulator: Simulator) -> None:
        """Keep a simulator if it holds what no other does."""
        key = {(id(anatomy), simulator.config.wall_reach_mm) for anatomy in simulator.set_up.anatomies}
        if not key <= self._kept:
            self._kept |= key
            self.simulators.append(simulator)

    def keep(self, members: Sequence[World]) -> None:
        """Forget all vessels but the given one and those of some members: maps take memory."""
        kept = {id(self.of(each)) for each in (World(), *members)}
        self._made = {alone: vessel for alone, vessel in self._made.items() if id(vessel) in kept}
        self.simulators = [each for each in self.simulators if {*map(id, each.set_up.anatomies)} <= kept]
        self._kept = {key for key in self._kept if key[0] in kept}

    def kinds(
        self, given: Stack, members: Sequence[World], budget: Budget | None = None
    ) -> tuple[list[tuple[Anatomy, Stack]], Int[np.ndarray, "members"]]:
        """Return vessels and devices of members, those that differ, and which of them each member has."""
        found: dict[World, int] = {}
        alike = [replace(each, friction_factor=1.0, ostium_mm=0.0, about="") for each in members]
        kind = np.array([found.setdefault(each, len(found)) for each in alike])
        return [(self.of(each, budget), each.stack(given)) for each in found], kind
