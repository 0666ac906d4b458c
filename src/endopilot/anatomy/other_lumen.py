"""A vessel whose lumen is wider or narrower than it is given: `with_radii`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from endopilot.anatomy.distance import CATHETER_LENGTH_MM, add_catheter
from endopilot.types import Anatomy, DistanceMap

_CHUNK = 1 << 18  # points of the grid that are looked at together
LEAST_MM = 0.02  # radius of a lumen that is closed, mm


def with_radii(anatomy: Anatomy, radii: Sequence[Float[np.ndarray, "_"]]) -> Anatomy:
    """Return the anatomy with other radii of each branch's points, mm, at least `LEAST_MM`; courses and the catheter
    stay. A map point moves with the sphere it lies deepest in, of least d² - r²: exact around a tube."""
    branches = anatomy.tree.branches
    radii = [np.maximum(np.asarray(radius, dtype=float), LEAST_MM) for radius in radii]
    lines = [replace(branch.centerline, radius=r) for branch, r in zip(branches, radii, strict=True)]
    new = tuple(replace(branch, centerline=line) for branch, line in zip(branches, lines, strict=True))
    old = [branch.centerline.radius for branch in branches]
    grown = np.concatenate([r - before for r, before in zip(radii, old, strict=True)])
    insertion = anatomy.insertion
    moved = _moved(anatomy, np.append(grown, 0.0))
    opened = add_catheter(moved, insertion, anatomy.catheter_radius_mm)
    return replace(anatomy, tree=replace(anatomy.tree, branches=new), distance_map=opened)


def _moved(anatomy: Anatomy, grown: Float[np.ndarray, "n"]) -> DistanceMap:
    """Return the map of an anatomy whose wall moves outwards by what each point's sphere grows, the catheter's last."""
    field = anatomy.distance_map
    values, (where, owner) = field.values.copy(), _owners(anatomy)
    at = tuple(where.T)
    values[at] = np.maximum(values[at] + grown[np.minimum(owner, len(grown) - 1)], float(field.values.min()))
    return replace(field, values=values)


@lru_cache(maxsize=1)
def _owners(anatomy: Anatomy) -> tuple[Int[np.ndarray, "points 3"], Int[np.ndarray, "points"]]:
    """Return an anatomy's map points within reach, and each one's sphere; the last anatomy's are kept."""
    insertion, field = anatomy.insertion, anatomy.distance_map
    lines = [branch.centerline for branch in anatomy.tree.branches]
    count = max(2, int(np.ceil(CATHETER_LENGTH_MM / anatomy.catheter_radius_mm)))
    behind = insertion.position - np.linspace(0.0, CATHETER_LENGTH_MM, 2 * count)[:, None] * insertion.direction
    centres = np.concatenate([*(line.points for line in lines), behind])
    radius = np.concatenate([*(line.radius for line in lines), np.full(len(behind), anatomy.catheter_radius_mm)])
    where = np.argwhere(field.values > field.values.min())
    # The nearest in one dimension more: sqrt(R² - r²) away, a sphere's squared distance is d² - r² + R².
    spheres = KDTree(np.column_stack([centres, np.sqrt(radius.max() ** 2 - radius**2)]))
    owner = np.empty(len(where), dtype=int)
    for first in range(0, len(where), _CHUNK):
        some = where[first : first + _CHUNK]
        points = field.origin_mm + field.spacing_mm * some[:, ::-1]
        _, owner[first : first + _CHUNK] = spheres.query(np.column_stack([points, np.zeros(len(points))]))
    return where, owner
