"""Repairs of the flaws that surfaces from elsewhere have: separate pieces, holes, inverted normals.

Every repair returns remarks, which `extract_anatomy` writes into the provenance.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy.ndimage import binary_dilation, binary_opening, distance_transform_edt
from scipy.spatial import KDTree

from endopilot.errors import InputError, place_text
from endopilot.types import Insertion, Volume
from endopilot.vessels.coverage import voxelised
from endopilot.vessels.graph import pieces
from endopilot.vessels.inlet import Vessel, piece_on_side
from endopilot.vessels.repair import NEAR_OSTIUM_MM, NOTED_MM, OTHER_SIDE, other_pieces_text
from endopilot.vessels.surface import Surface, surface_from_mask
from endopilot.vessels.topology import MOST_LISTED
from endopilot.vessels.walls import enclosed, lumen_in_wall, wall_text

MOST_PIECES = 12
"""At most this many pieces of a surface are looked at as coronary arteries or parts of them."""

_ACROSS = 120.0
"""A surface is looked at in voxels of this share of its box's mean edge: 2 million."""

_FACING = 0.12
"""Of a wall of 1 to 3 mm round lumens of 2 to 6 mm 0.15 to 0.5 of the surface faces itself on both sides."""

_HOLDS = 0.08
"""A shell of voxels holds at least this share of its own number: half a sixth."""

_OVERLAP = 20
"""Surfaces that have no more voxels than this in common touch."""


def closed_surface(
    surface: Surface,
    given: Insertion | None,
    label: str,
    vessel: Vessel = "generic",
    other_ostium: Float[np.ndarray, "3"] | None = None,
) -> tuple[Surface, list[str]]:
    """Return one closed wall with outward normals: largest piece (or the one at the ostium), holes capped.

    Where a file holds both coronary arteries and no ostium is given, `vessel` decides by the patient's side.

    Args:
        surface: one or several walls.
        given: the ostium, if it is known.
        label: name of the source, for messages.
        vessel: which vessel is wanted.
        other_ostium: ostium of the other coronary artery, LPS mm, if it is known.

    Raises:
        InputError: the holes cannot be closed, or the surface is nowhere near the given ostium.
    """
    mesh: Any = _without_duplicates(_polydata(surface.vertices, surface.faces).clean().triangulate())
    mesh, remarks = _lumen_of(mesh)
    regions = mesh.connectivity(extraction_mode="all")
    ids = np.asarray(regions.point_data["RegionId"])
    if ids.max() > 0:
        if given is None:
            chosen, others = _region_on_side(regions, ids, vessel)
        else:
            chosen, others = int(ids[np.linalg.norm(regions.points - given.position, axis=1).argmin()]), []
        joined, mesh = _united(regions, ids, chosen)
        others = [other for other in others if other not in joined]
        if others:
            remarks.append(other_pieces_text(vessel, len(others)))
        if len(joined) > 1:
            remarks.append(f"{len(joined)} closed surfaces overlap: united to one vessel")
        ids = np.where(np.isin(ids, joined), chosen, ids)
        remarks += _regions_left_out(
            np.asarray(regions.points, float), ids.astype(np.int64), chosen, vessel, other_ostium
        )
    if given is not None:
        gap = float(KDTree(mesh.points).query(given.position)[0])
        if gap > max(NEAR_OSTIUM_MM, 0.15 * float(np.ptp(mesh.points, axis=0).max())):
            raise InputError(
                f"{label}: the surface is {gap:.1f} mm from the ostium at {place_text(given.position)}; check "
                "coordinates"
            )
    open_edges = mesh.n_open_edges
    if open_edges:
        mesh = _capped(mesh)
        remarks.append(f"holes with {open_edges} open edges capped")
    mesh = mesh.compute_normals(
        cell_normals=False, point_normals=True, consistent_normals=True, split_vertices=False, auto_orient_normals=False
    )
    result = _surface(mesh)
    if mesh.n_open_edges or abs(result.volume) < 1e-9:
        result = _from_shell(result, label)
        remarks.append("the surface could not be capped and was closed by filling a voxel shell")
    if surface.volume < 0 and not open_edges:
        remarks.append("inverted normals turned outwards")
    if result.volume < 0:
        result = Surface(result.vertices, result.faces[:, ::-1])
    return result, remarks


def _lumen_of(mesh: Any) -> tuple[Any, list[str]]:
    """Return the inner faces of a wall that has a thickness, with a remark; any other mesh as it is.

    From a wall, unlike from a vessel, many lines along the normals meet the surface again on both sides.
    """
    if min(_met_again(mesh, sign) for sign in (1.0, -1.0)) < _FACING:
        return mesh, []
    closed = _surface(_capped(mesh))
    step = float(np.prod(np.ptp(closed.vertices, axis=0))) ** (1 / 3) / _ACROSS
    solid = voxelised(closed, step)
    found = lumen_in_wall(solid)
    if found is None:
        return mesh, []
    lumen, thickness = found
    faces = np.asarray(mesh.faces.reshape(-1, 4)[:, 1:])
    centres = np.asarray(mesh.points)[faces].mean(axis=1)
    index = tuple(np.rint((centres - solid.origin_mm) / solid.spacing_mm[0]).astype(int).T[::-1])
    near, far = (distance_transform_edt(~part) for part in (lumen, ~lumen & ~solid.voxels))
    inner = _polydata(mesh.points, faces[np.asarray(near)[index] < np.asarray(far)[index]]).clean()
    return inner.connectivity(extraction_mode="largest"), [wall_text(thickness)]


def _met_again(mesh: Any, sign: float) -> float:
    """Return from what share of triangles a line along the normal, or against it, meets the surface again."""
    from vtkmodules.vtkCommonCore import mutable
    from vtkmodules.vtkCommonDataModel import vtkStaticCellLocator

    locator: Any = vtkStaticCellLocator()
    locator.SetDataSet(mesh)
    locator.BuildLocator()
    centres, normals, _ = _surface(mesh).triangles()
    some = slice(None, None, max(1, len(centres) // 256))
    reach, met, cell = float(mesh.length), 0, mutable(0)
    for centre, normal in zip(centres[some], sign * normals[some], strict=True):
        line = (centre + 1e-4 * reach * normal, centre + reach * normal)
        met += locator.IntersectWithLine(*line, 0.0, mutable(0.0), [0.0] * 3, [0.0] * 3, cell) != 0
    return met / len(centres[some])


def _united(regions: Any, ids: np.ndarray, chosen: int) -> tuple[list[int], Any]:
    """Return which closed pieces of a surface overlap one, directly or by others, and the wall of all of them."""
    faces = regions.faces.reshape(-1, 4)[:, 1:]
    own = ids[faces[:, 0]]
    parts = {
        int(i): _surface(_capped(_polydata(regions.points, faces[own == i]).clean()))
        for i in np.argsort(-np.bincount(own))[:MOST_PIECES]
    } | {chosen: _surface(_capped(_polydata(regions.points, faces[own == chosen]).clean()))}
    lower, upper = regions.points.min(axis=0), regions.points.max(axis=0)
    step = max(
        min(abs(part.mean_radius) for part in parts.values()) / 4, float(np.prod(upper - lower)) ** (1 / 3) / _ACROSS
    )
    shape = tuple(int(size) for size in (np.ceil((upper - lower) / step).astype(int) + 9)[::-1])
    inside = {i: part.inside((shape[0], shape[1], shape[2]), lower - 4 * step, step) for i, part in parts.items()}
    joined, union = [chosen], inside[chosen].copy()
    for _ in parts:
        for i in set(parts) - set(joined):
            # What lies wholly inside is an island, and what only touches is another vessel.
            common = int((inside[i] & union).sum())
            if _OVERLAP < common < 0.9 * inside[i].sum():
                joined.append(i)
                union |= inside[i]
    if len(joined) == 1:
        return joined, _polydata(regions.points, faces[own == chosen]).clean()
    wall = surface_from_mask(Volume(union, np.full(3, step), lower - 4 * step, np.eye(3)))
    return joined, _polydata(wall.vertices, wall.faces)


def _polydata(points: Any, faces: np.ndarray) -> Any:
    import pyvista

    return pyvista.PolyData(np.asarray(points, dtype=float), np.insert(faces, 0, 3, axis=1).ravel())


def _surface(mesh: Any) -> Surface:
    return Surface(np.asarray(mesh.points, dtype=float), np.asarray(mesh.faces.reshape(-1, 4)[:, 1:], dtype=np.int64))


def region_places(surface: Surface) -> list[Float[np.ndarray, "3"]]:
    """Return a point on each of the largest connected parts of a surface, LPS mm."""
    regions = _polydata(surface.vertices, surface.faces).clean().triangulate().connectivity(extraction_mode="all")
    ids = np.asarray(regions.point_data["RegionId"])
    sizes = np.bincount(ids)
    return [np.asarray(regions.points[ids == i][0], float) for i in np.argsort(-sizes)[:MOST_PIECES] if sizes[i] >= 100]


def _regions_left_out(
    points: Float[np.ndarray, "n 3"],
    ids: Int[np.ndarray, "n"],
    chosen: int,
    vessel: Vessel,
    other_ostium: Float[np.ndarray, "3"] | None,
) -> list[str]:
    """Say which separate walls of a surface were left out and where they lie."""
    own = KDTree(points[ids == chosen])
    found: list[tuple[float, str]] = []
    for region in np.unique(ids[ids != chosen]):
        place = points[ids == region]
        extent = float(np.linalg.norm(np.ptp(place, axis=0)))
        if other_ostium is not None and np.linalg.norm(place - other_ostium, axis=1).min() < NEAR_OSTIUM_MM:
            found.append((np.inf, f"the {OTHER_SIDE[vessel]} ({len(place)} vertices) is not part of this one"))
        elif extent >= NOTED_MM:
            gap = np.asarray(own.query(place)[0])
            at = place_text(place[gap.argmin()])
            text = f"a separate piece of the surface left out: {extent:.0f} mm long, {gap.min():.1f} mm away at {at}"
            found.append((extent, text))
    remarks = [text for _, text in sorted(found, key=lambda item: -item[0])[:MOST_LISTED]]
    rest = len(np.unique(ids)) - 1 - len(remarks)
    if rest:
        longest = sorted((extent for extent, _ in found if np.isfinite(extent)), reverse=True)[MOST_LISTED:]
        size = f"{longest[0]:.0f}" if longest else f"{NOTED_MM:g}"
        remarks.append(f"{rest} more separate pieces of the surface of up to {size} mm left out")
    return remarks


def _region_on_side(regions, ids: np.ndarray, vessel: Vessel) -> tuple[int, list[int]]:
    pieces = [regions.points[ids == i] for i in range(min(int(ids.max()) + 1, 100))]
    sizes = np.array([np.linalg.norm(np.ptp(points, axis=0)) * len(points) ** 0.5 for points in pieces])
    return piece_on_side(sizes, np.array([points.mean(axis=0) for points in pieces]), vessel)


def _without_duplicates(mesh):
    """Drop triangles that occur twice, as where a surface was exported together with its own copy."""
    faces = np.asarray(mesh.faces.reshape(-1, 4)[:, 1:])
    _, first = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    if len(first) == len(faces):
        return mesh
    return _polydata(mesh.points, faces[np.sort(first)])


def _capped(mesh):
    """Close every hole by a fan of triangles from the centre of its rim to the rim's edges."""
    points, faces = np.asarray(mesh.points, dtype=float), np.asarray(mesh.faces.reshape(-1, 4)[:, 1:], dtype=np.int64)
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    _, inverse, uses = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True, return_counts=True)
    rim = edges[uses[inverse.reshape(-1)] == 1]
    if len(rim) == 0:  # edges that more than two triangles share: no hole, but nothing that a cap closes
        return mesh
    size = len(points)
    numbers, own = np.unique(pieces(rim, size)[rim[:, 0]], return_inverse=True)
    centres = np.stack([points[np.unique(rim[own == i])].mean(axis=0) for i in range(len(numbers))])
    fans = np.column_stack([rim[:, 1], rim[:, 0], size + own.reshape(-1)])
    closed = np.concatenate([faces, fans])
    return _polydata(np.concatenate([points, centres]), closed)


def _from_shell(surface: Surface, label: str) -> Surface:
    """Close a surface that no cap closes: voxels from which its wall is met in most directions are inside."""
    extent = np.ptp(surface.vertices, axis=0)
    spacing = max(float(np.prod(extent) / 3e6) ** (1 / 3), float(extent.max()) / 600)
    fine = surface.refined(0.7 * spacing)
    margin = 6
    origin = fine.vertices.min(axis=0) - margin * spacing
    shape = np.ceil(extent / spacing).astype(int) + 2 * margin + 1
    shell = np.zeros(tuple(shape[::-1]), dtype=bool)
    samples = np.concatenate([fine.vertices, fine.vertices[fine.faces].mean(axis=1)])
    index = np.rint((samples - origin) / spacing).astype(int)
    shell[index[:, 2], index[:, 1], index[:, 0]] = True
    inside = np.asarray(binary_opening(enclosed(shell)), dtype=bool)
    if inside.sum() > _HOLDS * shell.sum():
        inside = np.asarray(binary_dilation(inside), dtype=bool) & (inside | shell)
        return surface_from_mask(Volume(inside, np.full(3, spacing), origin, np.eye(3)))
    raise InputError(f"{label}: the surface has holes that cannot be closed; cap it or make it watertight")
