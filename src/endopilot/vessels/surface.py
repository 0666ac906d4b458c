"""The lumen's wall as triangles, from a mask with sub-voxel accuracy, and the signed distance to it on a grid."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from endopilot.errors import InputError
from endopilot.imaging.voxels import dilated
from endopilot.types import DistanceMap, Volume

SMOOTHING_VOXELS = 1.75  # SD, in longest edges, of the Gaussian under which the surface looks like the mask

ACROSS_EDGES = 0.75
"""It is wider in voxels along shorter edges, by this power of the edges' ratio: at 0, a wall nearly in the plane of
thick slices keeps their steps, which are long in the plane; at 1, the crotch of two lumens at 30° fills."""

_FIT_ITERATIONS = 8
_BLOCK = 24  # edge in voxels of the blocks that a mask is smoothed in
BAND_MM = 2.5  # how far outside the wall the distance map reaches, mm; beyond, it holds the constant −`BAND_MM`
MAXIMUM_GRID_POINTS = 20_000_000  # of a distance map (80 MB of float32); the spacing grows until it fits

_NEAREST_TRIANGLES = 4
_WORTH_THREADS = 20_000  # with fewer points than this, starting threads takes longer than they save


_NEAR_WALL = (2, 5)  # grid steps outside and inside the wall that are exact, the rest at every second point
_SLICES = 16  # a wall's inside is found so many slices at a time: 170 000 triangles in 0.15 s, all at once 1.2 s


@dataclass(frozen=True, eq=False)
class Surface:
    """A triangulated wall: positions, LPS mm, and three vertex indices a triangle."""

    vertices: Float[np.ndarray, "n 3"]
    faces: Int[np.ndarray, "m 3"]

    @cached_property
    def _corners(self) -> Float[np.ndarray, "m 3 3"]:
        return self.vertices[self.faces]

    @cached_property
    def _centroids(self) -> KDTree:
        return KDTree(self._corners.mean(axis=1))

    @cached_property
    def _frames(self) -> Float[np.ndarray, "m 12"]:
        """First corner of every triangle, the two edges from it, and these edges' products."""
        corners = self._corners
        one, two = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        products = [np.einsum("ij,ij->i", a, b)[:, None] for a, b in ((one, one), (one, two), (two, two))]
        return np.concatenate([corners[:, 0], one, two, *products], axis=1)

    def triangles(self) -> tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, "m 3"], Float[np.ndarray, "m"]]:
        """Return the triangles' centres, mm, unit normals, and areas, mm²."""
        edges = np.diff(self._corners, axis=1)
        normals = 0.5 * np.cross(edges[:, 0], edges[:, 1])
        areas = np.linalg.norm(normals, axis=1)
        return self._corners.mean(axis=1), normals / np.maximum(areas, 1e-12)[:, None], areas

    @property
    def volume(self) -> float:
        """Signed volume inside a closed wall, mm³; negative if the triangles' normals point inwards."""
        centre = self.vertices.mean(axis=0)
        first, second, third = np.moveaxis(self._corners - centre, 1, 0)
        return float(np.einsum("ij,ij->", first, np.cross(second, third)) / 6.0)

    @property
    def mean_radius(self) -> float:
        """Radius of the tube that has a closed wall's volume and area, mm."""
        return 2.0 * self.volume / float(self.triangles()[2].sum())

    def distance(self, points: Float[np.ndarray, "n 3"], *, limit_mm: float = np.inf) -> Float[np.ndarray, "n"]:
        """Return unsigned distances, mm, to the wall, at most `limit_mm`, by the nearest four centroids, or one where
        far: triangles must be about as small as the details that matter (`refined`)."""
        result = np.full(len(points), limit_mm)
        reach, count = limit_mm + self.longest_edge, min(_NEAREST_TRIANGLES, len(self.faces))
        for start in range(0, len(points), 200_000):
            part = np.ascontiguousarray(points[start : start + 200_000])
            workers = -1 if len(part) > _WORTH_THREADS else 1
            gap, nearest = map(np.asarray, self._centroids.query(part, k=[*range(1, count + 1)], workers=workers))  # pyright: ignore[reportArgumentType]
            near = np.flatnonzero(gap[:, 0] < 3.0 * self.longest_edge)
            far = np.flatnonzero((gap[:, 0] >= 3.0 * self.longest_edge) & (gap[:, 0] <= reach))
            for rows, index in ((near, nearest[near]), (far, nearest[far, :1])):
                squares = _square_distance(part[rows], self._frames, index)
                result[start + rows] = np.minimum(np.sqrt(squares.min(axis=1)), limit_mm)
        return result

    @cached_property
    def longest_edge(self) -> float:
        """Length of the longest edge of any triangle, mm."""
        corners = self._corners
        return float(np.sqrt(max(_edge_squares(corners, i).max() for i in range(3))))

    def refined(self, edge_mm: float) -> Surface:
        """Return the same wall with triangles whose edges are no longer than `edge_mm`, by halving the longest."""
        if self.longest_edge <= edge_mm:
            return self  # what is kept of it, such as its search tree, serves on
        vertices, faces = self.vertices, self.faces
        done: list[np.ndarray] = []
        while len(faces):
            corners = vertices[faces]
            squares = np.stack([_edge_squares(corners, i) for i in range(3)], axis=1)
            long = squares.max(axis=1) > edge_mm**2
            done.append(faces[~long])
            if not long.any():
                break
            faces, middle = _halved(faces[long], squares[long].argmax(axis=1), vertices)
            vertices = np.concatenate([vertices, middle])
        return Surface(vertices, np.concatenate(done))

    def inside(
        self, shape: tuple[int, int, int], origin: Float[np.ndarray, "3"], spacing_mm: float
    ) -> Bool[np.ndarray, "nz ny nx"]:
        """Return which points of a grid along the LPS axes lie inside a closed wall, a few slices at a time, for VTK
        looks at every triangle for every slice."""
        from vtkmodules.util.numpy_support import vtk_to_numpy
        from vtkmodules.vtkImagingStencil import vtkImageStencilToImage, vtkPolyDataToImageStencil

        heights = self._corners[..., 2] - origin[2]
        low, high = heights.min(axis=1) / spacing_mm, heights.max(axis=1) / spacing_mm
        result = np.zeros(shape, dtype=bool)
        for first in range(0, shape[0], _SLICES):
            last = min(first + _SLICES, shape[0]) - 1
            crossing = (high >= first - 1) & (low <= last + 1)
            if not crossing.any():
                continue
            stencil = vtkPolyDataToImageStencil()
            stencil.SetInputData(Surface(self.vertices, self.faces[crossing]).to_polydata())
            stencil.SetOutputOrigin(*(float(value) for value in origin))
            stencil.SetOutputSpacing(spacing_mm, spacing_mm, spacing_mm)
            stencil.SetOutputWholeExtent(0, shape[2] - 1, 0, shape[1] - 1, first, last)
            image = vtkImageStencilToImage()
            image.SetInputConnection(stencil.GetOutputPort())
            image.SetInsideValue(1)
            image.SetOutsideValue(0)
            image.SetOutputScalarTypeToUnsignedChar()
            image.Update()
            voxels = vtk_to_numpy(image.GetOutput().GetPointData().GetScalars())
            result[first : last + 1] = voxels.reshape(last + 1 - first, *shape[1:])
        return result

    def to_polydata(self):
        """Return the wall as a `vtkPolyData`."""
        return polydata_of(self.vertices, np.arange(0, 3 * len(self.faces) + 1, 3), self.faces.ravel(), "Polys")


def polydata_of(
    points: Float[np.ndarray, "n 3"],
    offsets: Int[np.ndarray, "k"],
    corners: Int[np.ndarray, "m"],
    kind: Literal["Polys", "Lines"],
):
    """Return cells as a `vtkPolyData`: indices of points, and where among these each cell begins, and the last ends."""
    from vtkmodules.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray
    from vtkmodules.vtkCommonCore import vtkPoints
    from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkPolyData

    places, cells, polydata = vtkPoints(), vtkCellArray(), vtkPolyData()
    places.SetData(numpy_to_vtk(np.ascontiguousarray(points, dtype=float), deep=True))
    cells.SetData(*(numpy_to_vtkIdTypeArray(np.ascontiguousarray(i, np.int64), deep=True) for i in (offsets, corners)))
    polydata.SetPoints(places)
    (polydata.SetPolys if kind == "Polys" else polydata.SetLines)(cells)
    return polydata


def surface_from_mask(mask: Volume) -> Surface:
    """Return the smooth wall whose blurred inside equals the blurred mask: the zero level of `level_function`. Raises
    InputError where the mask is nowhere thick enough to hold a lumen."""
    from skimage.measure import marching_cubes

    level, corner = smooth_level(mask)
    edges = mask.spacing_mm[::-1]
    if level.max() <= 0:
        raise InputError(
            f"the mask is nowhere thick enough to hold a lumen ({int(mask.voxels.sum())} voxels of "
            f"{mask.spacing_mm.round(2).tolist()} mm); segment on a finer grid"
        )
    shape, ratio = np.array(level.shape), edges / edges.min()
    factor = np.where(ratio > 1.5, np.ceil(ratio / 1.5), 1.0)
    for axis in np.flatnonzero(factor > 1):
        level = _finer(level, int(axis), int(factor[axis]))
    scale = (shape - 1) / (np.array(level.shape) - 1)
    vertices, faces, _, _ = marching_cubes(level, 0.0)
    index = vertices * scale + corner
    surface = Surface(mask.index_to_world(index[:, ::-1].astype(float)), faces.astype(np.int64))
    return surface if surface.volume > 0 else Surface(surface.vertices, surface.faces[:, ::-1])


def grid_of(
    lower: Float[np.ndarray, "3"], upper: Float[np.ndarray, "3"], spacing: float
) -> tuple[tuple[int, int, int], Float[np.ndarray, "3"]]:
    """Return the shape (nz, ny, nx) and the LPS origin of a grid that covers a box, mm."""
    counts = np.ceil((upper - lower) / spacing).astype(int) + 1
    return (int(counts[2]), int(counts[1]), int(counts[0])), np.asarray(lower, dtype=float)


def filled_box(voxels: Bool[np.ndarray, "nz ny nx"]) -> tuple[slice, slice, slice]:
    """Return the smallest box that holds all true voxels; an empty one if there are none."""
    box = []
    for axis in range(3):
        filled = np.flatnonzero(voxels.any(axis=tuple(other for other in range(3) if other != axis)))
        box.append(slice(int(filled[0]), int(filled[-1]) + 1) if len(filled) else slice(0, 0))
        voxels = voxels[(slice(None),) * axis + (box[-1],)]
    return (box[0], box[1], box[2])


def cropped(mask: Volume) -> tuple[Volume, Int[np.ndarray, "3"]]:
    """Return the smallest box of a mask that holds what is in it, and the voxel (z, y, x) that it begins at."""
    box = filled_box(mask.voxels)
    corner = np.array([part.start for part in box])
    origin = mask.index_to_world(corner[::-1].astype(float))
    return replace(mask, voxels=np.asarray(mask.voxels[box], dtype=bool), origin_mm=origin), corner


def blur_voxels(edges_mm: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    """Return the standard deviation in voxels of the Gaussian along each axis, for voxels with these edges in mm."""
    return SMOOTHING_VOXELS * (edges_mm.max() / edges_mm) ** ACROSS_EDGES


@lru_cache(maxsize=1)
def smooth_level(mask: Volume) -> tuple[Float[np.ndarray, "nz ny nx"], Int[np.ndarray, "3"]]:
    """Return the `level_function` of a mask on its filled box and a margin, and the voxel (z, y, x) it begins at. The
    last mask's is kept: what it is too thin to show is looked for before the wall is made of it."""
    margin, (own, corner) = 4, cropped(mask)
    return level_function(np.pad(own.voxels, margin), mask.spacing_mm[::-1]), corner - margin


def level_function(
    inside: Bool[np.ndarray, "nz ny nx"], edges_mm: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "nz ny nx"]:
    """Return about the signed distance to a mask's smooth wall in voxels, positive inside, constant far from it.

    A Gaussian of one voxel takes the staircase out of the mask, but also shrinks round vessels (by about σ²/2R).
    Therefore the level function d is not the blurred mask itself: it starts from σ·Φ⁻¹(G∗mask), which is exact for a
    plane, and is corrected by σ√2π·(G∗mask − G∗H(d)) until its own blurred inside agrees. H(d) is the share of a voxel
    that lies inside. The zero level keeps the mask's local volume, so radii are unbiased down to about one voxel. A
    vessel fills little of its box, so the box is worked through in blocks, and only in those that hold some wall.
    """
    from scipy.special import ndtri

    sigma, width = SMOOTHING_VOXELS, blur_voxels(edges_mm)
    gain, deepest = np.float32(sigma * np.sqrt(2 * np.pi)), sigma * ndtri(1 - 1e-4)
    kernels = [_blur_matrix(float(one)) for one in width]
    halo = [(kernel.shape[1] - _BLOCK) // 2 for kernel in kernels]
    count = [-(-size // _BLOCK) for size in inside.shape]
    padding = [(h, n * _BLOCK - size + h) for h, n, size in zip(halo, count, inside.shape, strict=True)]
    share = np.pad(inside, padding).astype(np.float32)
    result = np.where(inside, np.float32(deepest), np.float32(-deepest))
    blocks = []  # window with halo, window without it, target, where to correct, level
    for place in np.ndindex(*count):
        wide = tuple(slice(i * _BLOCK, (i + 1) * _BLOCK + 2 * h) for i, h in zip(place, halo, strict=True))
        part = share[wide]
        if not 0.0 < part.mean() < 1.0:
            continue
        target = _blurred(part, kernels)
        level = (sigma * ndtri(np.clip(target, 1e-4, 1 - 1e-4))).astype(np.float32)
        window = tuple(slice(w.start + h, w.stop - h) for w, h in zip(wide, halo, strict=True))
        blocks.append((wide, window, target, gain * ((target > 1e-3) & (target < 1 - 1e-3)), level))
    for _ in range(_FIT_ITERATIONS):
        for _, window, _, _, level in blocks:
            share[window] = np.clip(level + np.float32(0.5), 0.0, 1.0)
        for wide, _, target, correction, level in blocks:
            level += correction * (target - _blurred(share[wide], kernels))
    for _, window, _, _, level in blocks:
        own = tuple(slice(w.start - h, w.stop - h) for w, h in zip(window, halo, strict=True))
        view = result[own]
        view[...] = level[: view.shape[0], : view.shape[1], : view.shape[2]]
    return result


def _blur_matrix(width: float) -> Float[np.ndarray, "block wide"]:
    """Return the matrix that blurs a block and its halo along one axis with a Gaussian cut off at three widths."""
    reach = int(3.0 * width + 0.5)
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / width) ** 2)
    matrix = np.zeros((_BLOCK, _BLOCK + 2 * reach), dtype=np.float32)
    for row in range(_BLOCK):
        matrix[row, row : row + 2 * reach + 1] = weights / weights.sum()
    return matrix


def _blurred(
    part: Float[np.ndarray, "wz wy wx"], kernels: list[Float[np.ndarray, "block wide"]]
) -> Float[np.ndarray, "block block block"]:
    along_z = (kernels[0] @ np.ascontiguousarray(part).reshape(part.shape[0], -1)).reshape(-1, *part.shape[1:])
    return (kernels[1] @ along_z) @ kernels[2].T


def _finer(values: Float[np.ndarray, "a b c"], axis: int, factor: int) -> Float[np.ndarray, "d e f"]:
    from scipy.interpolate import CubicSpline

    size = values.shape[axis]
    weights = CubicSpline(np.arange(size), np.eye(size))(np.linspace(0.0, size - 1.0, factor * size))
    return np.moveaxis(np.tensordot(weights.astype(values.dtype), values, axes=(1, axis)), 0, axis)


def _halved(
    faces: Int[np.ndarray, "m 3"], longest: Int[np.ndarray, "m"], vertices: Float[np.ndarray, "n 3"]
) -> tuple[Int[np.ndarray, "halves 3"], Float[np.ndarray, "edges 3"]]:
    rows = np.arange(len(faces))
    one, two, opposite = faces[rows, longest], faces[rows, (longest + 1) % 3], faces[rows, (longest + 2) % 3]
    edges, inverse = np.unique(np.sort(np.stack([one, two], axis=1), axis=1), axis=0, return_inverse=True)
    new = len(vertices) + inverse.reshape(-1)
    halves = np.concatenate([np.stack([one, new, opposite], axis=1), np.stack([new, two, opposite], axis=1)])
    return halves, vertices[edges].mean(axis=1)


def _edge_squares(corners: Float[np.ndarray, "m 3 3"], edge: int) -> Float[np.ndarray, "m"]:
    difference = corners[:, (edge + 1) % 3] - corners[:, edge]
    return np.einsum("ij,ij->i", difference, difference)


def _square_distance(
    points: Float[np.ndarray, "n 3"], frames: Float[np.ndarray, "m 12"], index: Int[np.ndarray, "n k"]
) -> Float[np.ndarray, "n k"]:
    """Return the squared distances from each point to its k candidate triangles, given by `Surface._frames`."""
    frame = frames[index]
    relative = points[:, None, :] - frame[..., 0:3]
    own = np.einsum("nkj,nkj->nk", relative, relative)
    first = np.einsum("nkj,nkj->nk", relative, frame[..., 3:6])
    second = np.einsum("nkj,nkj->nk", relative, frame[..., 6:9])
    one, both, two = frame[..., 9], frame[..., 10], frame[..., 11]
    along, length = second - first - both + one, one - 2.0 * both + two  # of the edge between the edges' ends
    best = _edge_square(own, first, one)
    np.minimum(best, _edge_square(own, second, two), out=best)
    np.minimum(best, _edge_square(own - 2.0 * first + one, along, length), out=best)
    area = np.maximum(one * two - both * both, 1e-18)
    u, v = (two * first - both * second) / area, (one * second - both * first) / area
    above = (u >= 0) & (v >= 0) & (u + v <= 1)
    height = own - u * first - v * second
    return np.maximum(np.where(above, np.minimum(best, height), best), 0.0)


def _edge_square(
    own: Float[np.ndarray, "n k"], along: Float[np.ndarray, "n k"], length: Float[np.ndarray, "n k"]
) -> Float[np.ndarray, "n k"]:
    """Return squared distances to edges from those to their starts, the products with the edges, and their squares."""
    share = np.clip(along / np.maximum(length, 1e-18), 0.0, 1.0)
    return own + share * (share * length - 2.0 * along)


def distance_map_from_surface(surface: Surface, *, spacing_mm: float, band_mm: float = BAND_MM) -> DistanceMap:
    """Return the signed distance to a closed triangulated wall (LPS mm), kept up to `band_mm` outside it."""
    lower = surface.vertices.min(axis=0) - band_mm
    shape, origin = grid_of(lower, surface.vertices.max(axis=0) + band_mm, spacing_mm)
    inside = surface.inside(shape, origin, spacing_mm)
    surface = surface.refined(3.0 * spacing_mm)
    wanted = dilated(inside, math.ceil(band_mm / spacing_mm) + 2)
    values = _far_field(surface, inside, wanted, origin, spacing_mm, band_mm)
    outside = dilated(inside, _NEAR_WALL[0]) & ~inside
    index = np.argwhere(outside)
    values[outside] = -surface.distance(origin + spacing_mm * index[:, ::-1], limit_mm=band_mm)
    shallow = inside & dilated(~inside, _NEAR_WALL[1])
    index = np.argwhere(shallow)
    values[shallow] = surface.distance(origin + spacing_mm * index[:, ::-1])
    return DistanceMap(values=values, spacing_mm=float(spacing_mm), origin_mm=origin)


def _far_field(
    surface: Surface,
    inside: Bool[np.ndarray, "nz ny nx"],
    wanted: Bool[np.ndarray, "nz ny nx"],
    origin: Float[np.ndarray, "3"],
    spacing: float,
    band: float,
) -> Float[np.ndarray, "nz ny nx"]:
    """Return signed distances from every second (far inside, fourth) point, linear between: errs by h²/2ρ at most."""
    half = np.full(tuple((np.array(inside.shape) + 1) // 2 + 1), -band, dtype=np.float32)
    second, asked = inside[::2, ::2, ::2], wanted[::2, ::2, ::2]
    if (deep := second & ~dilated(~second, _NEAR_WALL[1])).any():
        around = dilated(deep, 2) & second
        own = tuple(slice(0, size) for size in second.shape)
        half[own][deep] = _far_field(surface, second, around, origin, 2 * spacing, band)[deep]
        asked = asked & ~deep
    coarse = np.argwhere(asked)
    within = second[tuple(coarse.T)]
    for part, sign, limit in ((coarse[within], 1.0, np.inf), (coarse[~within], -1.0, band)):
        half[tuple(part.T)] = sign * surface.distance(origin + 2 * spacing * part[:, ::-1], limit_mm=limit)
    values = half
    for axis in (2, 1, 0):
        size, first = inside.shape[axis], (slice(None),) * axis
        finer = np.empty((*values.shape[:axis], size, *values.shape[axis + 1 :]), dtype=np.float32)
        even = finer[(*first, slice(None, None, 2))] = values[(*first, slice((size + 1) // 2))]
        after = values[(*first, slice(1, size // 2 + 1))]
        finer[(*first, slice(1, None, 2))] = 0.5 * (even[(*first, slice(size // 2))] + after)
        values = finer
    return values
