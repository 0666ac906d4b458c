"""Repairs of flaws of surfaces from elsewhere: separate pieces, holes, inverted normals, walls (a phantom's shell) for
lumens, which they enclose; their remarks go into the provenance."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import binary_dilation, binary_erosion, binary_opening, distance_transform_edt
from scipy.spatial import KDTree

from endopilot.errors import InputError, place_text
from endopilot.imaging.grid import connected_components
from endopilot.types import Insertion, Volume
from endopilot.vessels.coverage import touched, voxelised
from endopilot.vessels.graph import pieces, split
from endopilot.vessels.inlet import Vessel
from endopilot.vessels.repair import NEAR_OSTIUM_MM, chosen_piece, pieces_left_out
from endopilot.vessels.surface import Surface, filled_box, surface_from_mask

MOST_PIECES = 12  # at most this many pieces of a surface are looked at as coronary arteries or parts of them

_ACROSS = 120.0  # a surface is looked at in voxels of this share of its box's mean edge: 2 million
_FACING = 0.12  # of a wall of 1 to 3 mm round lumens of 2 to 6 mm 0.15 to 0.5 of the surface faces itself on both sides
_HOLDS = 0.08  # a shell of voxels holds at least this share of its own number: half a sixth
_OVERLAP = 20  # surfaces that have no more voxels than this in common touch
_MOST_VOXELS = 2_000_000  # a mask of more is looked at in blocks: 0.5 s

_ENCLOSED = 16
"""A void is enclosed where the wall is met in this many of the 26 directions: 16 in the plane of a tube's open end,
13 or fewer between two branches."""

_REACH = 5  # the wall is looked for within 2 to the power of this many voxels

_UNIFORM, _LINING = 0.4, 0.9
"""A wall's thickness varies by at most this share of it (SD), and this share of it lines the lumen: not so a vessel
with a catheter or an island in it."""

_THICKEST = 4.0  # a wall is at most this many times as thick as its lumen's radius


def closed_surface(
    surface: Surface,
    given: Insertion | None,
    label: str,
    vessel: Vessel = "generic",
) -> tuple[Surface, list[str]]:
    """Return one closed wall with outward normals: largest piece (or that at the ostium), holes capped; arguments as of
    `connected_mask`. Raises InputError for holes that cannot be closed, or a surface nowhere near the ostium."""
    mesh: Any = _polydata(surface.vertices, surface.faces).clean().triangulate()
    faces = np.asarray(mesh.faces.reshape(-1, 4)[:, 1:])
    _, first = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)  # a triangle may stand there twice
    mesh, remarks = _lumen_of(mesh if len(first) == len(faces) else _polydata(mesh.points, faces[np.sort(first)]))
    regions = mesh.connectivity(extraction_mode="all")
    ids = np.asarray(regions.point_data["RegionId"]).astype(np.int64)
    if ids.max() > 0:
        places = split(np.asarray(regions.points, dtype=float), ids)
        sizes = np.array([np.linalg.norm(np.ptp(place, axis=0)) * len(place) ** 0.5 for place in places])
        chosen, *_ = chosen_piece(places, sizes, given, vessel)
        joined, mesh = _united(regions, ids, chosen)
        if len(joined) > 1:
            remarks.append(f"{len(joined)} closed surfaces overlap: united to one vessel")
        remarks += pieces_left_out(places, joined, np.empty(0, int), vessel, "vertices")
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
    """Return a thick wall's inner faces, with a remark, or the mesh: a normal meets a wall again on both sides."""
    if min(_met_again(mesh, sign) for sign in (1.0, -1.0)) < _FACING:
        return mesh, []
    closed = _surface(_capped(mesh))
    step = float(np.prod(np.ptp(closed.vertices, axis=0))) ** (1 / 3) / _ACROSS
    solid = voxelised(closed, step)
    found = _lumen_in_wall(solid)
    if found is None:
        return mesh, []
    lumen, thickness = found
    faces = np.asarray(mesh.faces.reshape(-1, 4)[:, 1:])
    centres = np.asarray(mesh.points)[faces].mean(axis=1)
    index = tuple(np.rint((centres - solid.origin_mm) / solid.spacing_mm[0]).astype(int).T[::-1])
    near, far = (distance_transform_edt(~part) for part in (lumen, ~lumen & ~solid.voxels))
    inner = _polydata(mesh.points, faces[np.asarray(near)[index] < np.asarray(far)[index]]).clean()
    return inner.connectivity(extraction_mode="largest"), [_wall_text(thickness)]


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
    largest = np.argsort(-np.bincount(own))[:MOST_PIECES].tolist()
    meshes = {i: _polydata(regions.points, faces[own == i]).clean() for i in (*largest, chosen)}
    parts = {i: _surface(_capped(mesh)) for i, mesh in meshes.items()}
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
        return joined, meshes[chosen]
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
    shell = touched(surface, spacing, 6)
    inside = np.asarray(binary_opening(_enclosed(shell.voxels)), dtype=bool)
    if inside.sum() > _HOLDS * shell.voxels.sum():
        inside = np.asarray(binary_dilation(inside), dtype=bool) & (inside | shell.voxels)
        return surface_from_mask(replace(shell, voxels=inside))
    raise InputError(f"{label}: the surface has holes that cannot be closed; cap it or make it watertight")


def _lumen_in_wall(mask: Volume) -> tuple[Bool[np.ndarray, "nz ny nx"], float] | None:
    """Return the void that a wall encloses, closed or open at the ends, and the wall's thickness, mm; None if none."""
    from skimage.measure import block_reduce

    box = filled_box(mask.voxels)
    solid = np.asarray(mask.voxels[box], dtype=bool)
    if solid.size == 0:
        return None
    factor = int(np.ceil((solid.size / _MOST_VOXELS) ** (1 / 3)))
    coarse = np.asarray(block_reduce(solid, factor, np.any), dtype=bool)  # pyright: ignore[reportArgumentType]
    edges = mask.spacing_mm[::-1] * factor
    void = _enclosed(coarse)
    labels = connected_components(void, corners=False)
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    lumen = labels == sizes.argmax()
    if sizes.max(initial=0) == 0:
        return None
    to_lumen = np.asarray(distance_transform_edt(~lumen, sampling=edges))
    outside = ~coarse & ~void
    rim = coarse & ~np.asarray(binary_erosion(~outside, border_value=False), dtype=bool)
    thickness = to_lumen[rim]
    middle = float(np.median(thickness)) if rim.any() else 0.0
    width = float(np.asarray(distance_transform_edt(lumen, sampling=edges)).max())
    lining = float((to_lumen[coarse] <= 1.5 * middle + edges.max()).mean())
    if lining < _LINING or np.std(thickness) > _UNIFORM * middle or middle > _THICKEST * width:
        return None
    whole = np.zeros(mask.voxels.shape, dtype=bool)
    fine = lumen
    for axis in range(3):
        fine = np.repeat(fine, factor, axis=axis)
    whole[box] = fine[tuple(slice(0, size) for size in solid.shape)] & ~solid
    return whole, middle


def without_wall(mask: Volume) -> tuple[Volume, list[str]]:
    """Return the lumen that a mask of a wall encloses, with a remark; any other mask as it is."""
    found = _lumen_in_wall(mask)
    if found is None:
        return mask, []
    return replace(mask, voxels=found[0]), [_wall_text(found[1])]


def _wall_text(thickness_mm: float) -> str:
    return f"what is given is a wall of {thickness_mm:.1f} mm: the lumen inside it is taken"


def _enclosed(solid: Bool[np.ndarray, "nz ny nx"]) -> Bool[np.ndarray, "nz ny nx"]:
    """Return the void from which a solid is met in most directions."""
    count = np.zeros(solid.shape, dtype=np.int8)
    for step in np.ndindex(3, 3, 3):
        direction = np.array(step) - 1
        if not direction.any():
            continue
        met = solid.copy()
        for power in range(_REACH):
            _or_shifted(met, direction * 2**power)
        count += met
    return (count >= _ENCLOSED) & ~solid


def _or_shifted(met: Bool[np.ndarray, "nz ny nx"], by: np.ndarray) -> None:
    if (np.abs(by) >= met.shape).any():
        return
    here = tuple(slice(max(0, -step), met.shape[axis] - max(0, step)) for axis, step in enumerate(by))
    there = tuple(slice(max(0, step), met.shape[axis] + min(0, step)) for axis, step in enumerate(by))
    met[here] |= met[there].copy()
