"""The vessel as a prior of where a wire can be: cross-sections along every branch, each a grid of places.

A wire that lies in the vessel passes through one place of every cross-section between the catheter and its tip. The
detector follows it from section to section.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int

from endopilot.anatomy.tree import tangents
from endopilot.types import Anatomy

STEP_MM, CELL_MM = 0.25, 0.2
"""Distance of the cross-sections, and of the places in one, mm."""
CATHETER_MM = 8.0
"""Length of the catheter behind the ostium in which a wire is followed, mm."""


@dataclass(frozen=True, eq=False)
class Passage:
    """One branch, or the end of the catheter: its cross-sections in the wire's direction.

    Attributes:
        branch: index in the tree; -1 for the catheter.
        parent: index of the passage before it in the corridor; -1 for the first.
        abscissa: of each section, mm.
        middle: LPS mm.
        first, second: unit vectors that span each section.
        room: distance from the middle that the wire's axis may have, mm.
    """

    branch: int
    parent: int
    abscissa: Float[np.ndarray, "n"]
    middle: Float[np.ndarray, "n 3"]
    first: Float[np.ndarray, "n 3"]
    second: Float[np.ndarray, "n 3"]
    room: Float[np.ndarray, "n"]

    @cached_property
    def offsets(self) -> Float[np.ndarray, "g"]:
        """Places of a section's grid along either axis, mm."""
        half = int(np.ceil(max(float(self.room.max()), CELL_MM) / CELL_MM))
        return CELL_MM * np.arange(-half, half + 1)

    @cached_property
    def open(self) -> Bool[np.ndarray, "n g g"]:
        """Which places lie within the room of the wire's axis."""
        distance = np.hypot(self.offsets[:, None], self.offsets)
        return distance <= np.maximum(self.room, CELL_MM)[:, None, None]

    @cached_property
    def cells(self) -> Int[np.ndarray, "k"]:
        """Indices of the open places in the flat array of all."""
        return np.flatnonzero(self.open)

    @cached_property
    def start(self) -> Int[np.ndarray, "n_and_1"]:
        """Which of the open places are a section's: from its number on, up to the next one's."""
        return np.concatenate([[0], np.cumsum(np.count_nonzero(self.open, axis=(1, 2)))])

    def places(self, section: Int[np.ndarray, "n"] | None = None) -> Float[np.ndarray, "n g g 3"]:
        """Return the places of the grids of some sections, or of all, LPS mm."""
        chosen = slice(None) if section is None else section
        aside = self.offsets[:, None, None] * self.first[chosen, None, None, :]
        across = self.offsets[None, :, None] * self.second[chosen, None, None, :]
        return self.middle[chosen, None, None, :] + aside + across

    def place(
        self, section: Int[np.ndarray, "k"], row: Int[np.ndarray, "k"], column: Int[np.ndarray, "k"]
    ) -> Float[np.ndarray, "k 3"]:
        """Return single places of some sections' grids, LPS mm."""
        aside = self.offsets[row, None] * self.first[section]
        return self.middle[section] + aside + self.offsets[column, None] * self.second[section]


@dataclass(frozen=True, eq=False)
class Corridor:
    """All passages: the catheter's end, then the branches, parents before their children."""

    passages: tuple[Passage, ...]


def make_corridor(anatomy: Anatomy, wire_radius_mm: float, slack_mm: float, deepest_mm: float) -> Corridor:
    """Return the cross-sections of a vessel up to some depth.

    Args:
        anatomy: the vessel.
        wire_radius_mm: of the wire.
        slack_mm: how far outside the lumen its axis may seem to lie, because registration is not perfect, mm.
        deepest_mm: abscissa at which the corridor ends, mm.
    """
    start, tree = anatomy.insertion, anatomy.tree
    at = np.arange(-CATHETER_MM, -0.5 * STEP_MM, STEP_MM)
    back = np.tile(start.direction, (len(at), 1))
    room = np.full(len(at), anatomy.catheter_radius_mm - wire_radius_mm + slack_mm)
    normal = np.cross(start.direction, np.eye(3)[int(np.abs(start.direction).argmin())])
    normal = np.tile(normal / np.linalg.norm(normal), (len(at), 1))
    middle = start.position + at[:, None] * start.direction
    passages = [Passage(-1, -1, at, middle, normal, np.cross(back, normal), room)]
    kept: dict[int, int] = {-1: 0}
    for index, branch in enumerate(tree.branches):
        line = branch.centerline
        if line.abscissa[0] >= deepest_mm or branch.parent not in kept:
            continue
        at = np.arange(line.abscissa[0] + 0.5 * STEP_MM, min(line.abscissa[-1], deepest_mm), STEP_MM)
        if len(at) == 0:
            kept[index] = kept[branch.parent]
            continue

        def along(values: np.ndarray, at: np.ndarray = at, line_at: np.ndarray = line.abscissa) -> np.ndarray:
            return np.stack([np.interp(at, line_at, part) for part in values.T], axis=-1)

        tangent, first = along(tangents(line.points)), along(line.normals)
        tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
        first -= (first * tangent).sum(axis=1, keepdims=True) * tangent
        first /= np.linalg.norm(first, axis=1, keepdims=True)
        radius = np.interp(at, line.abscissa, line.radius)
        kept[index] = len(passages)
        passages.append(
            Passage(
                index,
                kept[branch.parent],
                at,
                along(line.points),
                first,
                np.cross(tangent, first),
                radius - wire_radius_mm + slack_mm,
            )
        )
    return Corridor(tuple(passages))
