"""What a learning agent observes of a world, as docs/concepts/environment-specification.md has it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from gymnasium.spaces import Box, Dict, Space
from jaxtyping import Bool, Float, Int

from endopilot.anatomy.tree import parallel_transport, tangents
from endopilot.env.exposures import Exposed
from endopilot.simulation.simulator import Simulator
from endopilot.simulation.state import Step
from endopilot.tasks.navigation import Navigation
from endopilot.tasks.route import Route
from endopilot.types import TipProjection

STEP_MM = 0.5
"""Distance of the tables' places along the route, mm."""
AHEAD_MM = np.array([3.0, 6.0, 12.0, 24.0])
"""Distances ahead at which the route is observed, mm."""


@dataclass(frozen=True, eq=False)
class Place:
    """A place on the route of each world, and what lies ahead of it.

    Attributes:
        point: the place, LPS mm.
        frame: rows are the route's tangent there, and two normals that are carried along without twist.
        radius: lumen radius there, mm.
        ahead: the places `AHEAD_MM` farther on, in that frame and in units of that distance, one after another.
        radius_ahead: lumen radius at these, mm.
        on_route: whether the tip that it is nearest to lies in a branch of the route.
    """

    point: Float[np.ndarray, "worlds 3"]
    frame: Float[np.ndarray, "worlds 3 3"]
    radius: Float[np.ndarray, "worlds"]
    ahead: Float[np.ndarray, "worlds 12"]
    radius_ahead: Float[np.ndarray, "worlds 4"]
    on_route: Bool[np.ndarray, "worlds"]


@dataclass(frozen=True, eq=False)
class RouteTables:
    """The route of each world, from the ostium to the end of the target's branch.

    Attributes:
        places: of each route, a row for each place, every `STEP_MM` along it, as `Place` has it; a shorter route is
            padded with its last place.
        leave: of each route, for each branch of the tree, the abscissa where the path into it leaves the route, mm;
            infinite for the branches of the route and for those that the tree does not have.
        route: which of these routes each world has.
        target: abscissa of each world's target, mm.
    """

    places: Float[np.ndarray, "routes places columns"]
    leave: Float[np.ndarray, "routes branches"]
    route: Int[np.ndarray, "worlds"]
    target: Float[np.ndarray, "worlds"]

    @classmethod
    def of(cls, navigations: Sequence[Navigation]) -> RouteTables:
        """Make the tables, once for worlds that have the same navigation."""
        numbers = {key: number for number, key in enumerate(dict.fromkeys(map(id, navigations)))}
        route = np.array([numbers[id(navigation)] for navigation in navigations])
        ends = (navigations[world] for world in np.unique(route, return_index=True)[1])
        made = [_tables(Route.to(navigation.anatomy, navigation.target)) for navigation in ends]
        places, branches = max(len(row[0]) for row in made), max(len(row[1]) for row in made)
        return cls(
            places=np.stack([_padded(row[0], places) for row in made]),
            leave=np.stack([_padded(row[1], branches, np.inf) for row in made]),
            route=route,
            target=np.array([navigation.target.abscissa for navigation in navigations]),
        )

    def distance(self, tip: TipProjection) -> Float[np.ndarray, "worlds devices"]:
        """Return the path length from each tip to its target, mm, back out of a wrong branch first."""
        leave = self.leave[self.route[:, None], tip.branch]
        fork = np.minimum(leave, tip.abscissa)
        return (tip.abscissa - fork) + np.abs(self.target[:, None] - fork)

    def on_route(self, tip: TipProjection) -> Bool[np.ndarray, "worlds devices"]:
        """Return which tips lie in a branch of the route."""
        return np.isinf(self.leave[self.route[:, None], tip.branch])

    def place(self, tip: TipProjection) -> Place:
        """Return the place of each world's route that is nearest to its wire's tip along the tree."""
        leave = self.leave[self.route, tip.branch]
        along = np.rint(np.minimum(leave, tip.abscissa) / STEP_MM).astype(np.int64)
        row = self.places[self.route, np.minimum(np.maximum(along, 0), self.places.shape[1] - 1)]
        return Place(
            point=row[:, :3],
            frame=row[:, 3:12].reshape(-1, 3, 3),
            radius=row[:, 12],
            ahead=row[:, 13:25],
            radius_ahead=row[:, 25:],
            on_route=np.isinf(leave),
        )


def _tables(route: Route) -> tuple[np.ndarray, np.ndarray]:
    line = route.line
    along = np.arange(0.0, line.abscissa[-1], STEP_MM)
    point = np.column_stack([np.interp(along, line.abscissa, axis) for axis in line.points.T])
    radius = np.interp(along, line.abscissa, line.radius)
    tangent, normal = tangents(point), parallel_transport(point)
    frame = np.stack([tangent, normal, np.cross(tangent, normal)], axis=1)
    index = np.arange(len(along))[:, None] + np.rint(AHEAD_MM / STEP_MM).astype(np.int64)
    index = np.minimum(index, len(along) - 1)
    away = np.einsum("pij,pkj->pki", frame, (point[index] - point[:, None]) / AHEAD_MM[:, None])
    table = [point, frame.reshape(-1, 9), radius, away.reshape(len(along), -1), radius[index]]
    return np.column_stack(table), route.leaves_at


def _padded(rows: np.ndarray, count: int, value: float | None = None) -> np.ndarray:
    """Return `rows` with more of them, of `value` or like the last one."""
    more = np.repeat(rows[-1:], count - len(rows), axis=0)
    return np.concatenate([rows, more if value is None else np.full_like(more, value)])


_BOUND = 10.0
_OF_WIRE, _OF_CATHETER = 31, 8
"""Numbers of an observation: of the wire and its route, and of each catheter."""
_AT_DRIVES, _OF_TIP, _DRIVE_OF_CATHETER = 9, 23, 5
"""Numbers where X-ray shows the tip: of the wire's drive and the last exposure's age, of the tip, of each catheter."""
Observed = Literal["state", "xray", "image"]
"""What is observed: all as it truly is; or encoders, loads, and the last exposure, as a measured tip or images."""


def space(observed: Observed, catheters: int, images: tuple[int, int, int]) -> Space:
    """Return the space of one world's observation; what lies beyond is cut off."""
    if observed == "state":
        return Box(-_BOUND, _BOUND, (_OF_WIRE + _OF_CATHETER * catheters,), np.float32)
    of_tip = _OF_TIP if observed == "xray" else 0
    measured = Box(-_BOUND, _BOUND, (_AT_DRIVES + of_tip + _DRIVE_OF_CATHETER * catheters,), np.float32)
    return measured if observed == "xray" else Dict({"image": Box(0, 255, images, np.uint8), "measured": measured})


@dataclass(frozen=True, eq=False)
class Measured:
    """The worlds at one moment; row i belongs to world i.

    Attributes:
        tip: projections of the devices' tips to the centerline.
        position: of the tips, LPS mm.
        direction: unit vectors along the devices at their tips.
        contact_force: largest force of the wall on one node, N.
        inserted_length: Δ of the devices, mm.
        rotation: φ, rad.
        encoders: both as they are measured: by a robot's encoders where there is a robot.
        valid: false for a world that has failed.
    """

    tip: TipProjection
    position: Float[np.ndarray, "worlds devices 3"]
    direction: Float[np.ndarray, "worlds devices 3"]
    contact_force: Float[np.ndarray, "worlds"]
    inserted_length: Float[np.ndarray, "worlds devices"]
    rotation: Float[np.ndarray, "worlds devices"]
    encoders: Float[np.ndarray, "worlds devices 2"]
    valid: Bool[np.ndarray, "worlds"]

    @classmethod
    def after(cls, step: Step, simulator: Simulator, encoders: Float[np.ndarray, "worlds devices 2"]) -> Measured:
        """Return the worlds at the end of a step, with what encoders say."""
        return cls(
            tip=simulator.project(),
            position=step.tip_position,
            direction=step.tip_direction,
            contact_force=step.contact_force_max,
            inserted_length=step.inserted_length,
            rotation=step.rotation,
            encoders=encoders,
            valid=step.valid,
        )

    @classmethod
    def current(cls, simulator: Simulator, encoders: Float[np.ndarray, "worlds devices 2"]) -> Measured:
        """Return the worlds as they are now, with what encoders say."""
        return cls(
            tip=simulator.project(),
            position=simulator.tip_position,
            direction=simulator.tip_direction,
            contact_force=simulator.contacts.max(axis=1),
            inserted_length=simulator.inserted_length,
            rotation=simulator.rotation,
            encoders=encoders,
            valid=simulator.valid,
        )


def observe(
    now: Measured,
    routes: RouteTables,
    distances_mm: Float[np.ndarray, "worlds devices"],
    force_limit_n: Float[np.ndarray, "worlds"],
    time_share: Float[np.ndarray, "worlds"],
) -> Float[np.ndarray, "worlds features"]:
    """Return the observations, as the specification has them."""
    tip, inserted, turned = now.tip[:, 0], now.encoders[:, 0, 0], now.encoders[:, 0, 1]
    place = routes.place(tip)
    outside = np.empty((len(time_share), 3, 2))
    outside[:, :, 0] = now.direction[:, 0]
    outside[:, :, 1] = (now.position[:, 0] - place.point) / place.radius[:, None]
    inside = place.frame @ outside
    out = np.empty((len(time_share), _OF_WIRE + _OF_CATHETER * (now.rotation.shape[1] - 1)))
    out[:, 0] = inserted / 100.0
    out[:, 1], out[:, 2] = np.cos(turned), np.sin(turned)
    out[:, 3] = tip.abscissa / 100.0
    out[:, 4] = tip.offset / tip.radius
    out[:, 5] = distances_mm[:, 0] / 100.0
    out[:, 6] = place.on_route
    out[:, 7] = now.contact_force / force_limit_n
    out[:, 8] = time_share
    out[:, 9:12] = inside[:, :, 0]
    out[:, 12:14] = inside[:, 1:, 1]
    out[:, 14:26] = place.ahead
    out[:, 26:30] = place.radius_ahead / 2.0
    out[:, 30] = (inserted - tip.abscissa) / 10.0
    on_route = routes.on_route(now.tip)
    for device in range(1, now.rotation.shape[1]):
        begin = _OF_WIRE + _OF_CATHETER * (device - 1)
        tip, (inserted, turned) = now.tip[:, device], now.encoders[:, device].T
        out[:, begin] = inserted / 100.0
        out[:, begin + 1], out[:, begin + 2] = np.cos(turned), np.sin(turned)
        out[:, begin + 3] = tip.abscissa / 100.0
        out[:, begin + 4] = tip.offset / tip.radius
        out[:, begin + 5] = distances_mm[:, device] / 100.0
        out[:, begin + 6] = on_route[:, device]
        out[:, begin + 7] = (inserted - tip.abscissa) / 10.0
    return _bounded(out)


def observe_exposed(
    proximal: Float[np.ndarray, "worlds devices 4"],
    exposed: Exposed,
    routes: RouteTables | None,
    time_s: Float[np.ndarray, "worlds"],
    time_share: Float[np.ndarray, "worlds"],
) -> Float[np.ndarray, "worlds features"]:
    """Return what is measured, as the specification has it.

    Args:
        proximal: Δ, mm, φ, rad, and the drives' force and torque, N and N·mm, as they are measured.
        routes: the paths to the targets; not given where exposures are images.
    """
    around = proximal.shape[1] - 1
    of_tip = 0 if routes is None else _OF_TIP
    out = np.empty((len(time_s), _AT_DRIVES + of_tip + _DRIVE_OF_CATHETER * around))
    begins = (0, *(_AT_DRIVES + of_tip + _DRIVE_OF_CATHETER * k for k in range(around)))
    for begin, (inserted, turned, force, torque) in zip(begins, proximal.transpose(1, 2, 0), strict=True):
        out[:, begin] = inserted / 100.0
        out[:, begin + 1], out[:, begin + 2] = np.cos(turned), np.sin(turned)
        out[:, begin + 3], out[:, begin + 4] = force / 0.5, torque / 0.5
    out[:, 5] = time_share
    out[:, 6] = (time_s - exposed.time_s) / 10.0
    since = proximal[:, 0, :2] - exposed.encoders
    out[:, 7], out[:, 8] = since[:, 0] / 10.0, since[:, 1] / np.pi
    if routes is not None:
        tip = exposed.tip[:, 0]
        place, begin = routes.place(tip), _AT_DRIVES
        out[:, begin] = tip.abscissa / 100.0
        out[:, begin + 1] = tip.offset / tip.radius
        out[:, begin + 2] = routes.distance(exposed.tip)[:, 0] / 100.0
        out[:, begin + 3] = place.on_route
        away = (exposed.position - place.point) / place.radius[:, None]
        out[:, begin + 4 : begin + 6] = (place.frame[:, 1:] @ away[..., None])[..., 0]
        out[:, begin + 6 : begin + 18] = place.ahead
        out[:, begin + 18 : begin + 22] = place.radius_ahead / 2.0
        out[:, begin + 22] = (exposed.encoders[:, 0] - tip.abscissa) / 10.0
    return _bounded(out)


def _bounded(values: Float[np.ndarray, "worlds features"]) -> Float[np.ndarray, "worlds features"]:
    return np.minimum(np.maximum(values, -_BOUND, out=values), _BOUND, out=values).astype(np.float32)
