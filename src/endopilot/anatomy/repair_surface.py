"""Repairs of the flaws that surfaces from elsewhere have: separate pieces, holes, inverted normals.

Every repair returns remarks, which `extract_anatomy` writes into the provenance.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.ndimage import binary_closing, binary_fill_holes, binary_opening
from scipy.spatial import KDTree

from endopilot.anatomy.lumen_graph import pieces
from endopilot.anatomy.parent_vessel import Vessel, piece_on_side
from endopilot.anatomy.repair import NEAR_OSTIUM_MM, NOTED_MM, OTHER_SIDE, other_pieces_text
from endopilot.anatomy.surface import Surface, surface_from_mask
from endopilot.anatomy.topology import MOST_LISTED
from endopilot.errors import InputError, place_text
from endopilot.types import Insertion, Volume

MOST_PIECES = 12
"""At most this many pieces of a surface are looked at as coronary arteries or parts of them."""


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
    import pyvista

    remarks = []
    faces = np.insert(surface.faces, 0, 3, axis=1).ravel()
    mesh: Any = _without_duplicates(pyvista.PolyData(surface.vertices, faces).clean().triangulate())
    regions = mesh.connectivity(extraction_mode="all")
    ids = np.asarray(regions.point_data["RegionId"])
    if ids.max() > 0:
        if given is None:
            chosen, others = _region_on_side(regions, ids, vessel)
            if others:
                remarks.append(other_pieces_text(vessel, len(others)))
        else:
            chosen = int(ids[np.linalg.norm(regions.points - given.position, axis=1).argmin()])
        faces = regions.faces.reshape(-1, 4)
        mesh = pyvista.PolyData(regions.points, faces[ids[faces[:, 1]] == chosen].ravel()).clean()
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
    result = Surface(np.asarray(mesh.points, dtype=float), np.asarray(mesh.faces.reshape(-1, 4)[:, 1:], dtype=np.int64))
    if mesh.n_open_edges or abs(result.volume) < 1e-9:
        result = _from_shell(result, label)
        remarks.append("the surface could not be capped and was closed by filling a voxel shell")
    if surface.volume < 0 and not open_edges:
        remarks.append("inverted normals turned outwards")
    if result.volume < 0:
        result = Surface(result.vertices, result.faces[:, ::-1])
    return result, remarks


def region_places(surface: Surface) -> list[Float[np.ndarray, "3"]]:
    """Return a point on each of the largest connected parts of a surface, LPS mm."""
    import pyvista

    faces = np.insert(surface.faces, 0, 3, axis=1).ravel()
    regions: Any = pyvista.PolyData(surface.vertices, faces).clean().triangulate().connectivity(extraction_mode="all")
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
    """Return the wanted piece of a surface and the others that are nearly as large, by their boxes' diagonals."""
    pieces = [regions.points[ids == i] for i in range(min(int(ids.max()) + 1, 100))]
    sizes = np.array([np.linalg.norm(np.ptp(points, axis=0)) * len(points) ** 0.5 for points in pieces])
    return piece_on_side(sizes, np.array([points.mean(axis=0) for points in pieces]), vessel)


def _without_duplicates(mesh):
    """Drop triangles that occur twice, as where a surface was exported together with its own copy."""
    import pyvista

    faces = np.asarray(mesh.faces.reshape(-1, 4)[:, 1:])
    _, first = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    if len(first) == len(faces):
        return mesh
    return pyvista.PolyData(np.asarray(mesh.points), np.insert(faces[np.sort(first)], 0, 3, axis=1).ravel())


def _capped(mesh):
    """Close every hole by a fan of triangles from the centre of its rim to the rim's edges."""
    import pyvista

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
    return pyvista.PolyData(np.concatenate([points, centres]), np.insert(closed, 0, 3, axis=1).ravel())


def _from_shell(surface: Surface, label: str) -> Surface:
    """Close a surface that no cap closes: voxels that the wall shuts off from outside are inside."""
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
    for closing in (0, 2, 4):
        wall = binary_closing(shell, iterations=closing) if closing else shell
        inside = binary_fill_holes(wall)
        assert inside is not None
        core = np.asarray(binary_opening(inside & ~shell), dtype=bool)
        if core.sum() > 0.5 * shell.sum() / 6:
            volume = Volume(core | (inside & shell), np.full(3, spacing), origin, np.eye(3))
            return surface_from_mask(volume)
    raise InputError(f"{label}: the surface has holes that cannot be closed; cap it or make it watertight")
