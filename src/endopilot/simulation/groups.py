"""Worlds in groups: those with an equal anatomy and equal devices are stepped by one simulation of the core."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Integer

from endopilot.anatomy.projection import TipProjector
from endopilot.devices.drive_limits import far_end_mm
from endopilot.devices.stack import Stack
from endopilot.simulation.checks import check_distance_map, check_memory
from endopilot.simulation.config import FREE_BEHIND_MM, SimulatorConfig
from endopilot.simulation.core import make_simulation
from endopilot.simulation.motion import Motion
from endopilot.simulation.processor import CoreMotion, Lumen, Simulation, core_for
from endopilot.simulation.rod import LONGEST_ELEMENTS, RodLayout, lay_out
from endopilot.simulation.transmission import lay_out_transmission
from endopilot.simulation.tubes import lay_out_tubes
from endopilot.simulation.vessel_wall import make_wall
from endopilot.types import Anatomy

GroupKey = tuple[str, tuple[Any, ...]]
"""Identity of an anatomy, and constants of its devices."""
_KEPT = 4
"""Walls that are kept for the next simulator; each takes 4 bytes a point of the distance map."""
_walls: dict[tuple[Any, ...], Lumen] = {}
"""The last walls that were made, the latest last."""


@dataclass(frozen=True, eq=False)
class Group:
    """The worlds with an equal anatomy and equal devices.

    Attributes:
        anatomy: the vessel, as the first of them has it.
        stack: the wire and its catheters, as the first of them has it.
        rod: its nodes and stiffnesses.
        lumen: the wall, as the core has it.
        wall: how far outside the wall it goes, mm, and how the stiffness of the wall varies along the vessel.
        motion: of the vessel, as the core has it; None if it lies still.
        simulation: the worlds, as the core has them.
        index: their numbers, ascending.
        path_mm: length of the vessel's longest path.
        longest_mm: inserted length that the wire is laid out for.
        project: projection to the vessel's centerline.
    """

    anatomy: Anatomy
    stack: Stack
    rod: RodLayout
    lumen: Lumen
    wall: tuple[float, tuple[float, ...]]
    motion: CoreMotion | None
    simulation: Simulation
    index: Integer[np.ndarray, "members"]
    path_mm: float
    longest_mm: float
    project: TipProjector


def group_key(anatomy: Anatomy, stack: Stack) -> GroupKey:
    """Return what worlds have in common that are stepped together."""
    return anatomy.identity, stack.constants


def _wall_key(anatomy: Anatomy, stack: Stack) -> tuple[str, float, bool]:
    """Return what worlds with the same wall have in common."""
    return anatomy.identity, stack.outer_radius_mm, bool(stack.catheters)


def _wall(anatomy: Anatomy, stack: Stack, config: SimulatorConfig) -> Lumen:
    """Return a vessel's wall, as it was made where it is one of the last few: that takes longer than a short run."""
    key = (*_wall_key(anatomy, stack), config.wall_reach_mm, config.wall_along, config.processor)
    wall = _walls.pop(key, None)
    if wall is None:
        check_distance_map(anatomy)
        wall = make_wall(anatomy, stack, config)
    _walls[key] = wall
    while len(_walls) > _KEPT:
        _walls.pop(next(iter(_walls)), None)
    return wall


def make_groups(
    anatomies: Sequence[Anatomy],
    stacks: Sequence[Stack],
    motion: Motion | None,
    config: SimulatorConfig,
    sharing: Sequence[Group],
    reach_mm: float,
) -> list[Group]:
    """Return the groups of worlds, with their wires laid out and at the ostium.

    Args:
        anatomies: of each world.
        stacks: wire and catheters of each world.
        motion: of every vessel about its ostium; None if they lie still.
        config: settings of the rod core.
        sharing: groups whose lumens and projections are taken rather than prepared again.
        reach_mm: inserted length that devices are laid out for, mm; the far end of each vessel if that is more.

    Raises:
        InputError: a device that does not fit its anatomy or the catheter around it; a distance map that is not finite,
            or negative at the ostium; more worlds than the memory holds.
    """
    core, wall = core_for(config.processor), (config.wall_reach_mm, config.wall_along)
    prepared = [group for group in sharing if isinstance(group.lumen, core.Lumen) and group.wall == wall]
    lumens = {_wall_key(group.anatomy, group.stack): group.lumen for group in prepared}
    projectors = {group.anatomy.identity: group.project for group in sharing}
    members: dict[GroupKey, list[int]] = {}
    for world, pair in enumerate(zip(anatomies, stacks, strict=True)):
        members.setdefault(group_key(*pair), []).append(world)
    groups = []
    for worlds in members.values():
        anatomy, stack = anatomies[worlds[0]], stacks[worlds[0]]
        stack.check(anatomy)
        key = _wall_key(anatomy, stack)
        if key not in lumens:
            lumens[key] = _wall(anatomy, stack, config)
        if anatomy.identity not in projectors:
            projectors[anatomy.identity] = TipProjector(anatomy.tree, anatomy.insertion)
        path_mm = float(anatomy.tree.longest_path().abscissa[-1])
        longest_mm = max(far_end_mm(anatomy), reach_mm)
        fewest = int(longest_mm / (LONGEST_ELEMENTS * config.element_mm))
        check_memory(8 * len(worlds) * 40 * fewest, f"reach_mm: wires of {longest_mm:g} mm", "push less far")
        rod = lay_out(stack.wire, element_mm=config.element_mm, length_mm=longest_mm + FREE_BEHIND_MM)
        check_memory(8 * len(worlds) * (40 * len(rod.abscissa_mm) + 40), f"worlds: {len(worlds)}", "give fewer")
        moving = None if motion is None else motion.core(np.asarray(anatomy.insertion.position), config.processor)
        simulation = make_simulation(
            rod,
            lumens[key],
            anatomy.insertion,
            limits=stack.limits,
            push_limit_n=stack.push_limit_n,
            worlds=len(worlds),
            config=config,
            tubes=lay_out_tubes(stack, length_mm=longest_mm + FREE_BEHIND_MM),
            motion=moving,
            transmission=lay_out_transmission(stack, longest_mm=longest_mm + FREE_BEHIND_MM),
        )
        where = (np.array(worlds), path_mm, longest_mm, projectors[anatomy.identity])
        groups.append(Group(anatomy, stack, rod, lumens[key], wall, moving, simulation, *where))
    return groups
