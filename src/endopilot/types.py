"""The records that pass from one stage to the next.

Symbols of the paper (Kim et al. 2023), once for the whole package:

======  ==============================  ======================================================================
symbol  name here                       meaning
======  ==============================  ======================================================================
Δ       `inserted_length`, mm           length of wire beyond the ostium, measured along the wire
φ       `rotation`, rad                 rotation of the wire's proximal end about its own axis, unwrapped; 0 where the
                                        tip's bend points to `Insertion.rotation_zero`, and growing clockwise as
                                        the operator sees it, who looks along the catheter into the vessel
π       `control`, (mm/s, rad/s)        (dΔ/dt, dφ/dt), the mean over one sample period of 0.5 s
Δtip    `tip_abscissa`, mm              distance from the ostium along the centerline to the tip's projection
γtip    `tip_offset`, mm                distance from the tip to the centerline
======  ==============================  ======================================================================

World coordinates are LPS, in mm: +x to the patient's left, +y to the back, +z to the head, as in DICOM. Volumes are
indexed `voxels[k, j, i]`, where (i, j, k) count voxels along the first, second and third axis of the image.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from jaxtyping import Float, Int, Shaped

from endopilot.errors import InputError

if TYPE_CHECKING:  # slow to import
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from endopilot.tasks.navigation import Target
    from endopilot.tasks.targets import Place

SAMPLE_PERIOD_S = 0.5  # time between two recorded samples, s: the paper records at 2 Hz

_AXES = ("x (to the patient's left), mm", "y (to the back), mm", "z (to the head), mm")
_VIEWS = {"side": (1, 2), "front": (0, 2), "above": (0, 1)}  # axes to the right and up, by the axis looked along
_ON_AXIS = 0.05
"""A vessel whose mean lies off the catheter's axis by less than this share of its distance from the ostium lies to no
side. In atlas patients of all kinds it lies off by 0.12 at least (0.2 to 0.8 in the median of each kind)."""


@dataclass(frozen=True, eq=False)
class Volume:
    """A three-dimensional image: CT numbers in HU, or a mask, indexed [k, j, i]. `spacing_mm` lies between voxel
    centres along i, j and k, whose LPS unit vectors are the columns of `direction`; `origin_mm` is the LPS position of
    the centre of voxel (0, 0, 0). `notes` say what reading it from `files` changed or had to decide, a sentence
    each."""

    voxels: Shaped[np.ndarray, "nz ny nx"]
    spacing_mm: Float[np.ndarray, "3"]
    origin_mm: Float[np.ndarray, "3"]
    direction: Float[np.ndarray, "3 3"]
    notes: tuple[str, ...] = ()
    files: tuple[Path, ...] = ()

    def index_to_world(self, index: Shaped[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
        """Return the LPS position in mm of continuous voxel indices (i, j, k)."""
        return self.origin_mm + (index * self.spacing_mm) @ self.direction.T

    def world_to_index(self, points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
        """Return the continuous voxel indices (i, j, k) of LPS positions in mm."""
        return ((points - self.origin_mm) @ self.direction) / self.spacing_mm


@dataclass(frozen=True, eq=False)
class Insertion:
    """Where the device enters the vessel: the ostium, and the axis of the guiding catheter that ends there.

    Attributes:
        position: centre of the ostium, LPS mm.
        direction: unit vector along the catheter, pointing into the vessel.
        rotation_zero: unit vector across the catheter to which the bend of a tip points at φ = 0. An `Anatomy` that is
            made without one gets that of its vessel (`VesselTree.rotation_zero`). "world axes" is the rule of anatomies
            written before they held one: the shortest turn from the head's direction (+z) to `direction` takes −y
            there. So it is, too, where there is no vessel.
    """

    position: Float[np.ndarray, "3"]
    direction: Float[np.ndarray, "3"]
    rotation_zero: Float[np.ndarray, "3"] | Literal["world axes"] | None = None


@dataclass(frozen=True, eq=False)
class LumenMask:
    """The segmented inside of one vessel tree: boolean voxels, true inside the lumen, where the device enters, if that
    was found or given, and the name of the segmentation method, or where the mask came from. `warnings` say what
    reading the CT or the mask changed, and what the segmentation doubts, a sentence each."""

    volume: Volume
    ostium: Insertion | None = None
    method: str = "given"
    warnings: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Refuse what is no volume and no insertion, and name the constructors."""
        if not isinstance(self.volume, Volume):
            raise InputError(
                f"LumenMask: volume is {type(self.volume).__name__}; give LumenMask(Volume(voxels, spacing_mm, "
                "origin_mm, direction))"
            )
        if not isinstance(self.ostium, Insertion | None):
            raise InputError(
                f"LumenMask: ostium is {type(self.ostium).__name__}; give ostium=Insertion(position, direction)"
            )


@dataclass(frozen=True, eq=False)
class Centerline:
    """One unbranched line through a vessel, from the ostium outwards: points, LPS mm, the radius of the largest sphere
    around each that fits in the lumen, mm, the distance from the ostium along the line, mm, and unit vectors
    perpendicular to the line, carried along it without twist (parallel transport)."""

    points: Float[np.ndarray, "n 3"]
    radius: Float[np.ndarray, "n"]
    abscissa: Float[np.ndarray, "n"]
    normals: Float[np.ndarray, "n 3"]

    @staticmethod
    def joined(lines: Iterable[Centerline]) -> Centerline:
        """Return the points of several lines as those of one, in their order."""
        parts = [vars(line).values() for line in lines]
        return Centerline(*map(np.concatenate, zip(*parts, strict=True)))


@dataclass(frozen=True, eq=False)
class Branch:
    """A piece of the tree between two branching points, or from one to a distal end.

    The first point of a branch is the last point of its parent, so that every path is one connected line. Its abscissa
    counts from the ostium; `parent` indexes `VesselTree.branches` (-1 for the root), `section` for every point
    `VesselTree.section_names`.
    """

    centerline: Centerline
    parent: int
    section: Int[np.ndarray, "n"]


@dataclass(frozen=True, eq=False)
class VesselTree:
    """The centerline of a vessel with its branches, parents before their children, the first from the ostium on, and
    the names of the anatomical sections, such as the segments of AHA/SCCT."""

    branches: tuple[Branch, ...]
    section_names: tuple[str, ...]

    @property
    def line(self) -> Centerline:
        """The points of all branches as those of one line, in their order."""
        return Centerline.joined(branch.centerline for branch in self.branches)

    @property
    def sections_present(self) -> tuple[str, ...]:
        """Those of `section_names` that a point of this tree belongs to, in their order."""
        present = {int(section) for branch in self.branches for section in np.unique(branch.section)}
        return tuple(self.section_names[section] for section in sorted(present))

    def children(self, branch: int) -> tuple[int, ...]:
        """Return the indices of the branches that leave at the end of `branch`."""
        return tuple(i for i, candidate in enumerate(self.branches) if candidate.parent == branch)

    def leaves(self, branch: int = 0) -> tuple[int, ...]:
        """Return the indices of the branches that end distally, of those that a route through `branch` leads to."""
        parents = {branch.parent for branch in self.branches}
        ends = tuple(i for i in range(len(self.branches)) if i not in parents)
        return ends if branch == 0 else tuple(leaf for leaf in ends if branch in self.route(leaf))

    def longest_leaf(self, branch: int = 0) -> int:
        """Return the index of the leaf, of those that a route through `branch` leads to, that ends farthest from the
        ostium along the tree."""
        return max(self.leaves(branch), key=lambda leaf: self.branches[leaf].centerline.abscissa[-1])

    def route(self, branch: int) -> tuple[int, ...]:
        """Return the indices of the branches from the root to `branch`, both included."""
        route = [branch]
        while self.branches[route[-1]].parent >= 0:
            route.append(self.branches[route[-1]].parent)
        return tuple(reversed(route))

    def departures(self, branch: int) -> Float[np.ndarray, "branches"]:
        """Return the abscissa, mm, where the route to each branch leaves the route to `branch`; infinite on it."""
        route, at = self.route(branch), np.full(len(self.branches), np.inf)
        for index in set(range(len(self.branches))) - set(route):
            first = next(b for b in self.route(index) if b not in route)
            at[index] = self.branches[first].centerline.abscissa[0]
        return at

    def path(self, branch: int) -> Centerline:
        """Return the connected line from the ostium to the end of `branch`."""
        lines = [self.branches[i].centerline for i in self.route(branch)]
        rest = [Centerline(*(values[1:] for values in vars(line).values())) for line in lines[1:]]
        return Centerline.joined([lines[0], *rest])

    def longest_path(self) -> Centerline:
        """Return the path from the ostium to the farthest distal end."""
        return self.path(self.longest_leaf())

    def widest_axes(self) -> tuple[int, int]:
        """Return the world axes to the right and up for an eye that looks along the one of least extent."""
        return list(_VIEWS.values())[int(np.argmin(np.ptp(self.line.points, axis=0)))]

    def rotation_zero(self, insertion: Insertion) -> Float[np.ndarray, "3"]:
        """Return where a tip's bend points at φ = 0: to the side of the catheter's axis on which the vessel lies.

        That is where the mean of all centerlines, by their length, lies off the axis: it turns with the vessel, and
        small changes of the vessel turn it little. Where the mean lies on the axis, as in a straight tube, it is the
        patient's front; the head, where the catheter itself points to front or back.
        """
        lines = [branch.centerline.points for branch in self.branches]
        length = np.concatenate([np.linalg.norm(np.diff(points, axis=0), axis=1) for points in lines])
        middle = np.concatenate([0.5 * (points[1:] + points[:-1]) for points in lines])
        mean = length @ (middle - insertion.position) / max(float(length.sum()), 1e-12)
        axis, front, head = insertion.direction, np.array([0.0, -1.0, 0.0]), np.array([0.0, 0.0, 1.0])
        across = mean - (mean @ axis) * axis
        if not np.linalg.norm(across) > _ON_AXIS * np.linalg.norm(mean):
            side = front if abs(axis @ front) < np.cos(np.pi / 6) else head
            across = side - (side @ axis) * axis
        return across / np.linalg.norm(across)


@dataclass(frozen=True, eq=False)
class DistanceMap:
    """Distance to the vessel wall, mm, positive inside, on a grid along the LPS axes, indexed [k, j, i] along z, y, x,
    of one spacing and from the LPS position of `values[0, 0, 0]` on, mm. It is cut off at a fixed negative value
    outside; the guiding catheter that ends at the ostium counts as inside."""

    values: Float[np.ndarray, "nz ny nx"]
    spacing_mm: float
    origin_mm: Float[np.ndarray, "3"]


@dataclass(frozen=True, eq=False)
class Anatomy:
    """One patient's vessel, ready for simulation: a name, unique within a study, the centerline with branches and
    section labels, the distance to the wall, the ostium with the catheter's axis and φ's zero, the inner radius of the
    guiding catheter in the distance map, mm, and what it was made from, and how (written to `anatomy.json`)."""

    name: str
    tree: VesselTree
    distance_map: DistanceMap
    insertion: Insertion
    catheter_radius_mm: float
    provenance: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.insertion.rotation_zero is None:
            zero = self.tree.rotation_zero(self.insertion)
            object.__setattr__(self, "insertion", replace(self.insertion, rotation_zero=zero))

    def __repr__(self) -> str:
        branches, length = len(self.tree.branches), float(self.tree.longest_path().abscissa[-1])
        sections = ", ".join(self.tree.sections_present)
        return f"Anatomy(name={self.name!r}, branches={branches}, longest_path_mm={length:.1f}, sections={sections!r})"

    def target(self, place: Place, *, depth_mm: float | None = None) -> Target:
        """Return the target that is meant, as navigations, environments and commands understand it: the middle of a
        section such as "4" or "LAD", or the place `depth_mm` beyond its begin; a point X, Y, Z in LPS mm, moved to the
        centerline; or a target, which is checked. InputError where that names nothing, or what is not in the vessel."""
        find_target = import_module("endopilot.tasks.targets").find_target  # by name: this module imports no room
        return find_target(self.tree, place, depth_mm=depth_mm)

    def plot(
        self,
        *,
        axes: Axes | None = None,
        view: Literal["front", "side", "above"] | None = None,
        color: str | None = None,
    ) -> Figure:
        """Draw the centerlines, as thick as the vessel is wide, with the sections by colour, and the ostium.

        Without `axes` (LPS mm) in a new figure of pyplot, without `view` across the vessel's largest extents. A `color`
        of the whole vessel, for what is drawn over it, takes the place of the sections and their legend.
        """
        import matplotlib.pyplot as plt

        from endopilot.plotting import draw_vessel

        lines = [(branch.centerline, branch.section) for branch in self.tree.branches]
        pieces = np.concatenate([np.stack([line.points[:-1], line.points[1:]], axis=1) for line, _ in lines])
        across, up = _VIEWS[view] if view else self.tree.widest_axes()
        axes = axes or plt.figure(figsize=(7, 5.5), layout="constrained").subplots()
        radius = np.concatenate([line.radius[1:] for line, _ in lines])
        section = np.concatenate([own[1:] for _, own in lines])
        axes.plot(*self.insertion.position[[across, up]], "k^", zorder=3, label="ostium")
        draw_vessel(axes, pieces[..., [across, up]], radius, section, self.tree.section_names, color)
        axes.set(xlabel=_AXES[across], ylabel=_AXES[up], title=self.name)
        return axes.figure  # pyright: ignore[reportReturnType]

    @cached_property
    def identity(self) -> str:
        """SHA-256 of the vessel itself: centerlines, distance map, insertion and catheter.

        It is computed once, so change no array in place after that. Name, section labels and provenance do not count.
        An anatomy has the same identity in memory as on disk, where the distance map is float32. φ's zero counts, but
        for that of the world's axes, which the rest decides.
        """
        digest = hashlib.sha256()
        for branch in self.tree.branches:
            for values in vars(branch.centerline).values():
                _add(digest, values, np.float64)
            _add(digest, np.array(branch.parent), np.int64)
        _add(digest, self.distance_map.values, np.float32)
        grid, place = self.distance_map, self.insertion
        numbers = [grid.spacing_mm, grid.origin_mm, place.position, place.direction, self.catheter_radius_mm]
        numbers += [place.rotation_zero] if isinstance(place.rotation_zero, np.ndarray) else []
        for values in numbers:
            _add(digest, np.asarray(values), np.float64)
        return digest.hexdigest()


@dataclass(frozen=True, eq=False)
class TipProjection:
    """Where tips lie in the tree: Δtip, mm (negative in the catheter), γtip, mm, branch, and lumen radius there, mm."""

    abscissa: Float[np.ndarray, "..."]
    offset: Float[np.ndarray, "..."]
    branch: Int[np.ndarray, "..."]
    radius: Float[np.ndarray, "..."]

    def __getitem__(self, chosen: Any) -> TipProjection:
        """Return some of the tips, chosen as of an array: `tip[:, 0]` are those of the wires."""
        return TipProjection(self.abscissa[chosen], self.offset[chosen], self.branch[chosen], self.radius[chosen])


def _add(digest: hashlib._Hash, values: np.ndarray, kind: type[np.generic]) -> None:
    digest.update(repr(values.shape).encode())
    digest.update(np.ascontiguousarray(values, dtype=np.dtype(kind).newbyteorder("<")).data)
