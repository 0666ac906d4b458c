"""Worlds in groups, those with an equal anatomy and equal devices in one simulation of the core, and what is read of
them at any time: `Readout`."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any
from weakref import WeakValueDictionary

import numpy as np
from jaxtyping import Bool, Float, Int, Integer
from scipy.spatial import KDTree

from endopilot.anatomy.distance import CATHETER_LENGTH_MM
from endopilot.anatomy.projection import TipProjector
from endopilot.anatomy.tree import tangents
from endopilot.devices.drive_limits import far_end_mm
from endopilot.devices.stack import Stack
from endopilot.simulation.checks import check_distance_map, check_memory
from endopilot.simulation.config import FREE_BEHIND_MM, CoreMotion, Lumen, Simulation, SimulatorConfig
from endopilot.simulation.core import make_lumen, make_simulation
from endopilot.simulation.motion import Motion
from endopilot.simulation.rod import LONGEST_ELEMENTS, RodLayout, lay_out, lay_out_transmission, lay_out_tubes
from endopilot.simulation.trajectory import SimulationSetUp
from endopilot.types import Anatomy, Centerline, DistanceMap, TipProjection, VesselTree

FINE_MM = 0.2  # spacing of a finer grid, mm, at most: a tube's axis then reads at most 0.1 mm too near to the wall

_APART_MM = 0.1  # distance between the points of the guiding catheter's axis that are looked at, mm


def make_wall(anatomy: Anatomy, stack: Stack, config: SimulatorConfig) -> Lumen:
    """Return an anatomy's wall as the core wants it for a stack. A spline rounds the distance's ridge on the axis by up
    to half the map's spacing; for catheters hardly narrower than the vessel its grid is finer, and the inscribed
    spheres make it sharp."""
    check_distance_map(anatomy)
    radius_mm = stack.outer_radius_mm
    varies = config.wall_along or config.wall_around
    field = _stiffened(anatomy, radius_mm, config) if varies else anatomy.distance_map
    lumen = partial(make_lumen, field, radius_mm, config.processor, far_mm=config.wall_reach_mm)
    wall = lumen()
    if not stack.catheters or _leaves_room(wall, anatomy, radius_mm):
        return wall
    finer = max(2, math.ceil(field.spacing_mm / FINE_MM))
    return lumen(finer=finer, spheres=_inscribed_spheres(wall, anatomy))


def factor_at(
    abscissa_mm: Float[np.ndarray, "*n"], tree: VesselTree, factors: Sequence[float]
) -> Float[np.ndarray, "*n"]:
    """Return a factor at abscissae, mm; `factors` are at even distances from behind the ostium to the longest end."""
    ends = np.linspace(0.0, float(tree.longest_path().abscissa[-1]), len(factors)) if len(factors) > 1 else [0.0]
    return np.interp(abscissa_mm, ends, factors)


def _stiffened(anatomy: Anatomy, radius_mm: float, config: SimulatorConfig) -> DistanceMap:
    """Return a map by which the wall is softer than where it is stiffest, along the vessel and around it: a spring
    K d²/2 is c² times as stiff where the map gives c d. So none grows, for the core takes a wall to be as far as the
    map says; the largest factor is the core's own stiffness (`core_options`)."""
    field, tree = anatomy.distance_map, anatomy.tree
    lines = [branch.centerline for branch in tree.branches]
    line, values = Centerline.joined(lines), field.values.copy()
    where = np.argwhere(values > values.min())
    points, place = field.origin_mm + field.spacing_mm * where[:, ::-1], tuple(where.T)
    _, at = KDTree(line.points).query(points)
    factor = factor_at(line.abscissa[at], tree, config.wall_along or (1.0,))
    if around := config.wall_around:
        side, normal = points - line.points[at], line.normals[at]
        other = np.cross(np.concatenate([tangents(each.points) for each in lines])[at], normal)
        turn = np.arctan2((side * other).sum(axis=1), (side * normal).sum(axis=1)) / (2 * np.pi)
        factor = factor * np.interp(turn, np.arange(len(around)) / len(around), around, period=1.0)
    root = np.sqrt(factor / config.wall_factors(max))
    values[place] = np.maximum(radius_mm + root * (values[place] - radius_mm), values.min())
    return replace(field, values=values)


def _leaves_room(wall: Lumen, anatomy: Anatomy, radius_mm: float) -> bool:
    """Return whether a device finds room on the axis wherever vessel and guiding catheter are wider than it."""
    behind = np.arange(-FREE_BEHIND_MM, _APART_MM / 2, _APART_MM)
    axis = anatomy.insertion.position + behind[:, None] * anatomy.insertion.direction
    lines = [(axis, np.full(len(axis), anatomy.catheter_radius_mm))]
    lines += [(branch.centerline.points, branch.centerline.radius) for branch in anatomy.tree.branches]
    return not any(np.any((radius > radius_mm) & (wall.distance(points) < radius_mm)) for points, radius in lines)


def _inscribed_spheres(wall: Lumen, anatomy: Anatomy) -> Float[np.ndarray, "lines 8"]:
    """Return the inscribed spheres along the centerlines and the guiding catheter's axis, as `make_lumen` takes them,
    none wider than the rounded wall allows."""
    rounded_off = 0.5 * anatomy.distance_map.spacing_mm
    lines = []
    for branch in anatomy.tree.branches:
        points = branch.centerline.points
        radius = np.fmin(branch.centerline.radius, wall.distance(points) + rounded_off)
        lines.append(np.column_stack([points[:-1], points[1:], radius[:-1], radius[1:]]))
    ostium, direction = anatomy.insertion.position, anatomy.insertion.direction
    guiding = [*(ostium - CATHETER_LENGTH_MM * direction), *ostium, *[anatomy.catheter_radius_mm] * 2]
    return np.concatenate([*lines, [guiding]])


GroupKey = tuple[str, tuple[Any, ...]]  # identity of an anatomy, and constants of its devices


@dataclass(frozen=True, eq=False)
class Vessel:
    """A vessel as it is prepared for some devices: its wall, and what projects tips to its centerlines."""

    wall: Any
    project: TipProjector


_prepared: WeakValueDictionary[tuple[Any, ...], Vessel] = WeakValueDictionary()
_last: deque[Vessel] = deque(maxlen=4)  # are kept for the next simulator; each takes 4 bytes a point of its map


def prepared(anatomy: Anatomy, make: Callable[[], Any], *made_of: Any) -> Vessel:
    """Return a vessel with the wall that `made_of` says; one that a simulator has, or that was one of the last, is not
    made again: that takes longer than a short run."""
    key = anatomy.identity, *made_of
    if (vessel := _prepared.get(key)) is None:
        vessel = _prepared[key] = Vessel(make(), TipProjector(anatomy.tree, anatomy.insertion))
    if vessel not in _last:
        _last.append(vessel)
    return vessel


@dataclass(frozen=True, eq=False)
class Group:
    """The worlds with an equal anatomy and equal devices; `anatomy` and `stack` are those of the first.

    Attributes:
        motion: of the vessel, None if it lies still; as the core has it, as is `simulation`.
        index: the worlds' numbers, ascending.
        path_mm: length of the vessel's longest path; `longest_mm`: inserted length that the wire is laid out for.
    """

    anatomy: Anatomy
    stack: Stack
    rod: RodLayout
    vessel: Vessel
    motion: CoreMotion | None
    simulation: Simulation
    index: Integer[np.ndarray, "members"]
    path_mm: float
    longest_mm: float


def group_key(anatomy: Anatomy, stack: Stack) -> GroupKey:
    """Return what worlds have in common that are stepped together."""
    return anatomy.identity, stack.constants


def make_groups(
    anatomies: Sequence[Anatomy],
    stacks: Sequence[Stack],
    motion: Motion | None,
    config: SimulatorConfig,
    reach_mm: float,
) -> list[Group]:
    """Return the groups of worlds, with wires laid out (`reach_mm`, or to the vessel's far end if deeper) at the
    ostium, about which vessels move by `motion`. Raises InputError as `Simulator`."""
    members: dict[GroupKey, list[int]] = {}
    for world, pair in enumerate(zip(anatomies, stacks, strict=True)):
        members.setdefault(group_key(*pair), []).append(world)
    groups = []
    for worlds in members.values():
        anatomy, stack = anatomies[worlds[0]], stacks[worlds[0]]
        stack.check(anatomy)
        of_config = config.wall_reach_mm, config.wall_along, config.wall_around, config.processor
        made_of = stack.outer_radius_mm, bool(stack.catheters), *of_config
        vessel = prepared(anatomy, partial(make_wall, anatomy, stack, config), *made_of)
        path_mm = float(anatomy.tree.longest_path().abscissa[-1])
        longest_mm = max(far_end_mm(anatomy), reach_mm)
        fewest = int(longest_mm / (LONGEST_ELEMENTS * config.element_mm))
        check_memory(8 * len(worlds) * 40 * fewest, f"reach_mm: wires of {longest_mm:g} mm", "push less far")
        rod = lay_out(stack.wire, element_mm=config.element_mm, length_mm=longest_mm + FREE_BEHIND_MM)
        check_memory(8 * len(worlds) * (40 * len(rod.abscissa_mm) + 40), f"worlds: {len(worlds)}", "give fewer")
        moving = None if motion is None else motion.core(np.asarray(anatomy.insertion.position), config.processor)
        simulation = make_simulation(
            rod,
            vessel.wall,
            anatomy.insertion,
            limits=stack.limits,
            push_limit_n=stack.push_limit_n,
            worlds=len(worlds),
            config=config,
            tubes=lay_out_tubes(stack, length_mm=longest_mm + FREE_BEHIND_MM),
            motion=moving,
            transmission=lay_out_transmission(
                stack, longest_mm=longest_mm + FREE_BEHIND_MM, processor=config.processor
            ),
        )
        groups.append(Group(anatomy, stack, rod, vessel, moving, simulation, np.array(worlds), path_mm, longest_mm))
    return groups


class Readout:
    """Devices, loads and tips of worlds as they are now; `Simulator` moves them.

    Arrays have a row a world, in the order in which the worlds were given; where they have an axis of devices, the wire
    comes first, then the catheters around it from the inside out.

    Example:
        >>> simulator.reset(seed=0)
        >>> simulator.worlds, simulator.devices, simulator.nodes == simulator.position.shape[1]
        (4, 1, True)
        >>> of_devices = simulator.inserted_length, simulator.rotation, simulator.drive_rotation
        >>> pairs = simulator.proximal, simulator.at_drive, simulator.base_load, simulator.drive_load, simulator.slip
        >>> tips = simulator.tip_position, simulator.tip_direction
        >>> [each[0].shape[-1] for each in (of_devices, pairs, tips)]
        [1, 2, 3]
        >>> simulator.contacts.shape == simulator.orientation.shape[:2] and bool(simulator.active_nodes.max() > 0)
        True
        >>> simulator.time, simulator.valid, simulator.reason  # s; which are valid; why they are not
        (array([0., 0., 0., 0.]), array([ True,  True,  True,  True]), array([0, 0, 0, 0]))
        >>> bool((simulator.vessel_to_laboratory[:, :, :3] == np.eye(3)).all())  # a vessel that lies still
        True
        >>> tip = simulator.project()
        >>> bool((tip.offset < tip.radius).all())
        True
    """

    _groups: Sequence[Group]
    _set_up: SimulationSetUp
    _devices: int
    _rows: Int[np.ndarray, "worlds"]

    @property
    def worlds(self) -> int:
        """Number of worlds."""
        return len(self._rows)

    @property
    def devices(self) -> int:
        """Number of devices of a world: the wire, and the catheters around it."""
        return self._devices

    @property
    def nodes(self) -> int:
        """Nodes of the longest wire; arrays with a row a node are padded to this."""
        return max(group.simulation.nodes for group in self._groups)

    def project(self) -> TipProjection:
        """Project tips to the centerline: Δtip, γtip and lumen radius, mm, and branch of each world and device."""
        return self._projected([group.simulation.tips() for group in self._groups])

    @property
    def inserted_length(self) -> Float[np.ndarray, "worlds devices"]:
        """Inserted lengths Δ, mm."""
        return self._gather("inserted_length")

    @property
    def rotation(self) -> Float[np.ndarray, "worlds devices"]:
        """Rotations φ of the devices at the ostium, rad."""
        return self._gather("rotation")

    @property
    def drive_rotation(self) -> Float[np.ndarray, "worlds devices"]:
        """Rotations of the drives, rad: ahead of `rotation` by the twist of what lies between drive and ostium."""
        return self._gather("drive_rotation")

    @property
    def at_drive(self) -> Float[np.ndarray, "worlds devices 2"]:
        """Inserted lengths Δ (mm) and rotations (rad) as the drives make them, see `drive_rotation`."""
        return np.stack([self.inserted_length, self.drive_rotation], axis=-1)

    @property
    def proximal(self) -> Float[np.ndarray, "worlds devices 2"]:
        """Inserted lengths Δ (mm) and rotations φ (rad)."""
        return np.stack([self.inserted_length, self.rotation], axis=-1)

    @property
    def base_load(self) -> Float[np.ndarray, "worlds devices 2"]:
        """Axial force (N, positive when it pushes) and torque (N·mm) that hold each device where it enters."""
        return np.stack([self._gather("base_force"), self._gather("base_torque")], axis=-1)

    @property
    def drive_load(self) -> Float[np.ndarray, "worlds devices 2"]:
        """Force (N) and torque (N·mm) of the drives: `base_load` and what the valve takes; controls that move alike."""
        return np.stack([self._gather("drive_force"), self._gather("drive_torque")], axis=-1)

    @property
    def slip(self) -> Float[np.ndarray, "worlds devices 2"]:
        """Advance (mm) and rotation (rad) that the drives were asked for in the last step and did not make."""
        return np.stack([self._gather("slip"), self._gather("rotation_slip")], axis=-1)

    @property
    def tip_position(self) -> Float[np.ndarray, "worlds devices 3"]:
        """Where tips are, LPS mm."""
        return self._gather("tips")

    @property
    def tip_direction(self) -> Float[np.ndarray, "worlds devices 3"]:
        """Unit vectors along the devices at their tips."""
        return self._gather("tip_directions")

    @property
    def position(self) -> Float[np.ndarray, "worlds nodes 3"]:
        """Positions of the nodes from the foremost tip to the base, LPS mm; NaN beyond the nodes of a shorter wire."""
        return self._per_node("positions", np.nan)

    @property
    def orientation(self) -> Float[np.ndarray, "worlds nodes 4"]:
        """Orientations of the elements as quaternions w x y z; the third director points along the wire to its tip."""
        return self._per_node("attitudes", np.nan)

    @property
    def contacts(self) -> Float[np.ndarray, "worlds nodes"]:
        """Force of the wall at each node and at the middle of the element behind it, added up, N."""
        return self._per_node("contacts", 0.0)

    @property
    def active_nodes(self) -> Float[np.ndarray, "worlds"]:
        """Number of nodes ahead of the catheter, those that are solved for."""
        return self._gather("active")

    @property
    def time(self) -> Float[np.ndarray, "worlds"]:
        """Time since each world was put to its first inserted length, s; it is what the vessel moves with."""
        return self._gather("time")

    @property
    def vessel_to_laboratory(self) -> Float[np.ndarray, "worlds 3 4"]:
        """Where each vessel lies now: affine maps of its points, as CT shows them, to the laboratory, LPS mm."""
        return self._placements(self.time[:, None])[:, 0]

    @property
    def valid(self) -> Bool[np.ndarray, "worlds"]:
        """False for a world that left the finite numbers or did not converge; it stays as it was until it is reset."""
        return self.reason == 0

    @property
    def reason(self) -> Int[np.ndarray, "worlds"]:
        """Why a world is invalid: 0 valid, 1 not finite, 2 not converged, 3 the wire went through the wall."""
        return self._gather("reason").astype(int)

    def _projected(self, points: Sequence[Float[np.ndarray, "_ *n 3"]]) -> TipProjection:
        """Return where points of each group's worlds, LPS mm, lie with respect to their centerlines."""
        found = [group.vessel.project(each) for group, each in zip(self._groups, points, strict=True)]
        names = TipProjection.__dataclass_fields__
        return TipProjection(**{name: self._merge([getattr(tip, name) for tip in found]) for name in names})

    def _placements(self, times: Float[np.ndarray, "worlds samples"]) -> Float[np.ndarray, "worlds samples 3 4"]:
        still, parts = np.eye(3, 4), []
        for group, at in zip(self._groups, self._of_groups(times), strict=True):
            if group.motion is None:
                parts.append(np.tile(still, (*at.shape, 1, 1)))
            else:
                parts.append(group.motion.placements(np.ascontiguousarray(at.ravel()))[0].reshape(*at.shape, 3, 4))
        return self._merge(parts)

    def _of_groups(self, values: np.ndarray) -> list[np.ndarray]:
        return [values[group.index] for group in self._groups]

    def _merge(self, parts: Sequence[np.ndarray]) -> np.ndarray:
        return parts[0] if len(parts) == 1 else np.concatenate(parts)[self._rows]

    def _gather(self, name: str) -> np.ndarray:
        return self._merge([getattr(group.simulation, name)() for group in self._groups])

    def _per_node(self, name: str, pad: float) -> np.ndarray:
        parts = [getattr(group.simulation, name)() for group in self._groups]
        out = np.full((self.worlds, self.nodes, *parts[0].shape[2:]), pad)
        for group, part in zip(self._groups, parts, strict=True):
            out[group.index, : part.shape[1]] = part
        return out
