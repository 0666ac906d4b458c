"""The path to a target along the tree, as tables in which many worlds look up places at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from endopilot.anatomy.tree import parallel_transport, tangents
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
