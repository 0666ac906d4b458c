"""The way to a target along the tree, as tables that many worlds look places up in at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from endopilot.anatomy.tree import parallel_transport, tangents
from endopilot.env.task import Navigation
from endopilot.types import TipProjection

STEP_MM = 0.5
"""Distance of the tables' places along the route, mm."""


@dataclass(frozen=True, eq=False)
class Routes:
    """The route of each world, from the ostium to the end of the target's branch.

    Attributes:
        point: places every `STEP_MM` along the route, LPS mm; a shorter route is padded with its last place.
        frame: rows are the route's tangent there, and two normals that are carried along without twist.
        radius: lumen radius there, mm.
        leave: for each branch of the tree, the abscissa where the way into it leaves the route, mm; infinite for the
            branches of the route and for those that the tree does not have.
        target: abscissa of the target, mm.
    """

    point: Float[np.ndarray, "worlds places 3"]
    frame: Float[np.ndarray, "worlds places 3 3"]
    radius: Float[np.ndarray, "worlds places"]
    leave: Float[np.ndarray, "worlds branches"]
    target: Float[np.ndarray, "worlds"]

    @classmethod
    def of(cls, navigations: Sequence[Navigation]) -> Routes:
        """Make the tables, a row a navigation."""
        made: dict[int, tuple[np.ndarray, ...]] = {}
        for navigation in navigations:
            if id(navigation) not in made:
                made[id(navigation)] = _tables(navigation)
        rows = [made[id(navigation)] for navigation in navigations]
        places, branches = max(len(row[0]) for row in rows), max(len(row[3]) for row in rows)
        return cls(
            point=np.stack([_padded(row[0], places) for row in rows]),
            frame=np.stack([_padded(row[1], places) for row in rows]),
            radius=np.stack([_padded(row[2], places) for row in rows]),
            leave=np.stack([_padded(row[3], branches, np.inf) for row in rows]),
            target=np.array([navigation.target.abscissa for navigation in navigations]),
        )

    def on_route(self, tip: TipProjection) -> Bool[np.ndarray, "worlds"]:
        """Return which tips lie in a branch of their route."""
        return np.isinf(self.leave[np.arange(len(self.leave)), tip.branch])

    def distance(self, tip: TipProjection) -> Float[np.ndarray, "worlds"]:
        """Return the way that each tip still has to go, mm, back out of a wrong branch first."""
        leave = self.leave[np.arange(len(self.leave)), tip.branch]
        fork = np.minimum(leave, tip.abscissa)
        return (tip.abscissa - fork) + np.abs(self.target - fork)

    def place(self, tip: TipProjection) -> Int[np.ndarray, "worlds"]:
        """Return the place of the tables that is nearest to each tip along the tree."""
        leave = self.leave[np.arange(len(self.leave)), tip.branch]
        along = np.minimum(leave, tip.abscissa) / STEP_MM
        return np.clip(np.rint(along).astype(np.int64), 0, self.radius.shape[1] - 1)


def _tables(navigation: Navigation) -> tuple[np.ndarray, ...]:
    tree = navigation.anatomy.tree
    line = tree.path(navigation.target.branch)
    along = np.arange(0.0, line.abscissa[-1], STEP_MM)
    point = np.column_stack([np.interp(along, line.abscissa, axis) for axis in line.points.T])
    tangent, normal = tangents(point), parallel_transport(point)
    frame = np.stack([tangent, normal, np.cross(tangent, normal)], axis=1)
    return point, frame, np.interp(along, line.abscissa, line.radius), tree.departures(navigation.target.branch)


def _padded(rows: np.ndarray, count: int, value: float | None = None) -> np.ndarray:
    """Return `rows` with more of them, of `value` or like the last one."""
    more = np.repeat(rows[-1:], count - len(rows), axis=0)
    return np.concatenate([rows, more if value is None else np.full_like(more, value)])
