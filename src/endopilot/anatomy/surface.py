"""The lumen's wall as triangles: from a mask with sub-voxel accuracy, and the exact distance to it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from endopilot.errors import InputError
from endopilot.types import Volume

SMOOTHING_VOXELS = 1.75
"""Standard deviation, in longest edges, of the Gaussian under which the surface must look like the mask."""

ACROSS_EDGES = 0.75
"""It is wider in voxels along shorter edges, by this power of the edges' ratio: at 0, a wall nearly in the plane of
thick slices keeps their steps, which are long in the plane; at 1, the crotch of two lumens at 30° fills."""

_FIT_ITERATIONS = 8
_NEAREST_TRIANGLES = 4


@dataclass(frozen=True, eq=False)
class Surface:
    """A triangulated wall.

    Attributes:
        vertices: positions, LPS mm.
        faces: three vertex indices a triangle.
    """

    vertices: Float[np.ndarray, "n 3"]
    faces: Int[np.ndarray, "m 3"]

    @cached_property
    def _corners(self) -> Float[np.ndarray, "m 3 3"]:
        return self.vertices[self.faces]

    @cached_property
    def _centroids(self) -> KDTree:
        return KDTree(self._corners.mean(axis=1))

    @property
    def area(self) -> float:
        """Area of the wall, mm²."""
        edges = np.diff(self._corners, axis=1)
        return float(0.5 * np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1).sum())

    @property
    def volume(self) -> float:
        """Signed volume inside a closed wall, mm³; negative if the triangles' normals point inwards."""
        centre = self.vertices.mean(axis=0)
        first, second, third = np.moveaxis(self._corners - centre, 1, 0)
        return float(np.einsum("ij,ij->", first, np.cross(second, third)) / 6.0)

    def distance(self, points: Float[np.ndarray, "n 3"], *, limit_mm: float = np.inf) -> Float[np.ndarray, "n"]:
        """Return the unsigned distance in mm from points to the wall, `limit_mm` where it is at least that.

        The triangles are found by their centroids: the nearest four for points close to the wall, the nearest one
        alone for points so far that its neighbours cannot matter. They must therefore be about as small as the
        details that matter (see `refined`).
        """
        result = np.full(len(points), limit_mm)
        reach = limit_mm + self.longest_edge
        for start in range(0, len(points), 200_000):
            part = np.ascontiguousarray(points[start : start + 200_000])
            gap, nearest = self._centroids.query(part, distance_upper_bound=reach, workers=-1)
            gap, nearest = np.asarray(gap), np.asarray(nearest)
            near = np.flatnonzero(gap < 3.0 * self.longest_edge)
            far = np.flatnonzero((gap >= 3.0 * self.longest_edge) & np.isfinite(gap))
            count = min(_NEAREST_TRIANGLES, len(self.faces))
            candidates = self._centroids.query(part[near], k=[*range(1, count + 1)], workers=-1)[1]  # pyright: ignore[reportArgumentType]
            for rows, index in ((near, np.asarray(candidates)), (far, nearest[far, None])):
                squares = _square_distance(part[rows], self._corners, index)
                result[start + rows] = np.minimum(np.sqrt(squares.min(axis=1)), limit_mm)
        return result

    @cached_property
    def longest_edge(self) -> float:
        """Length of the longest edge of any triangle, mm."""
        corners = self._corners
        return float(np.sqrt(max(_edge_squares(corners, i).max() for i in range(3))))

    def refined(self, edge_mm: float) -> Surface:
        """Return the same wall with triangles whose edges are no longer than `edge_mm`, by halving the longest."""
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
        """Return which points of a grid along the LPS axes lie inside a closed wall."""
        from vtkmodules.util.numpy_support import vtk_to_numpy
        from vtkmodules.vtkImagingStencil import vtkImageStencilToImage, vtkPolyDataToImageStencil

        stencil = vtkPolyDataToImageStencil()
        stencil.SetInputData(self.to_polydata())
        stencil.SetOutputOrigin(*(float(value) for value in origin))
        stencil.SetOutputSpacing(spacing_mm, spacing_mm, spacing_mm)
        stencil.SetOutputWholeExtent(0, shape[2] - 1, 0, shape[1] - 1, 0, shape[0] - 1)
        image = vtkImageStencilToImage()
        image.SetInputConnection(stencil.GetOutputPort())
        image.SetInsideValue(1)
        image.SetOutsideValue(0)
        image.SetOutputScalarTypeToUnsignedChar()
        image.Update()
        return vtk_to_numpy(image.GetOutput().GetPointData().GetScalars()).reshape(shape).astype(bool)

    def to_polydata(self):
        """Return the wall as a `vtkPolyData`."""
        from vtkmodules.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray
        from vtkmodules.vtkCommonCore import vtkPoints
        from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkPolyData

        points, cells, polydata = vtkPoints(), vtkCellArray(), vtkPolyData()
        points.SetData(numpy_to_vtk(np.ascontiguousarray(self.vertices, dtype=float), deep=True))
        cells.SetData(
            numpy_to_vtkIdTypeArray(np.arange(0, 3 * len(self.faces) + 1, 3, dtype=np.int64), deep=True),
            numpy_to_vtkIdTypeArray(np.ascontiguousarray(self.faces, dtype=np.int64).ravel(), deep=True),
        )
        polydata.SetPoints(points)
        polydata.SetPolys(cells)
        return polydata


def surface_from_mask(mask: Volume) -> Surface:
    """Return the smooth wall whose blurred inside equals the blurred mask.

    A Gaussian of one voxel takes the staircase out of the mask, but also shrinks round vessels (by about σ²/2R).
    Therefore the level function d is not the blurred mask itself: it starts from σ·Φ⁻¹(G∗mask), which is exact for a
    plane, and is corrected by σ√2π·(G∗mask − G∗H(d)) until its own blurred inside agrees. H(d) is the share of a voxel
    that lies inside. The zero level keeps the mask's local volume, so radii are unbiased down to about one voxel.

    Args:
        mask: boolean voxels, at least one of them true.
    """
    from scipy.ndimage import gaussian_filter
    from scipy.special import ndtri
    from skimage.measure import marching_cubes

    margin = 4
    filled = np.nonzero(mask.voxels)
    lower = np.array([index.min() for index in filled])
    box = tuple(slice(low, index.max() + 1) for low, index in zip(lower, filled, strict=True))
    inside = np.pad(mask.voxels[box], margin).astype(np.float32)
    edges = mask.spacing_mm[::-1]
    sigma, width = SMOOTHING_VOXELS, SMOOTHING_VOXELS * (edges.max() / edges) ** ACROSS_EDGES
    target = gaussian_filter(inside, width, truncate=3.0)
    band = (target > 1e-3) & (target < 1 - 1e-3)
    level = (sigma * ndtri(np.clip(target, 1e-4, 1 - 1e-4))).astype(np.float32)
    gain = np.float32(sigma * np.sqrt(2 * np.pi))
    for _ in range(_FIT_ITERATIONS):
        share = np.clip(level + np.float32(0.5), 0.0, 1.0)
        level[band] += gain * (target - gaussian_filter(share, width, truncate=3.0))[band]
    if level.max() <= 0:
        raise InputError(
            f"the mask is nowhere thick enough to hold a lumen ({int(mask.voxels.sum())} voxels of "
            f"{mask.spacing_mm.round(2).tolist()} mm); segment on a finer grid"
        )
    ratio = edges / edges.min()
    factor = np.where(ratio > 1.5, np.ceil(ratio / 1.5), 1.0)
    for axis in np.flatnonzero(factor > 1):
        level = _finer(level, int(axis), int(factor[axis]))
    scale = (np.array(inside.shape) - 1) / (np.array(level.shape) - 1)
    vertices, faces, _, _ = marching_cubes(level, 0.0)
    index = vertices * scale - margin + lower
    surface = Surface(mask.index_to_world(index[:, ::-1].astype(float)), faces.astype(np.int64))
    return surface if surface.volume > 0 else Surface(surface.vertices, surface.faces[:, ::-1])


def _finer(values: Float[np.ndarray, "a b c"], axis: int, factor: int) -> Float[np.ndarray, "d e f"]:
    """Return values on a grid `factor` times finer along one axis, by a cubic spline from end to end."""
    from scipy.interpolate import CubicSpline

    size = values.shape[axis]
    weights = CubicSpline(np.arange(size), np.eye(size))(np.linspace(0.0, size - 1.0, factor * size))
    return np.moveaxis(np.tensordot(weights.astype(values.dtype), values, axes=(1, axis)), 0, axis)


def _halved(
    faces: Int[np.ndarray, "m 3"], longest: Int[np.ndarray, "m"], vertices: Float[np.ndarray, "n 3"]
) -> tuple[Int[np.ndarray, "halves 3"], Float[np.ndarray, "edges 3"]]:
    """Return triangles split at the middles of their longest edges, and these middles, which follow the vertices."""
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
    points: Float[np.ndarray, "n 3"], corners: Float[np.ndarray, "m 3 3"], index: Int[np.ndarray, "n k"]
) -> Float[np.ndarray, "n k"]:
    """Return the squared distances from each point to its k candidate triangles."""
    triangle = corners[index]
    best = np.full(index.shape, np.inf)
    edges = np.stack([triangle[:, :, (i + 1) % 3] - triangle[:, :, i] for i in range(3)], axis=2)
    relative = points[:, None, None, :] - triangle
    length = np.maximum(np.einsum("nkij,nkij->nki", edges, edges), 1e-18)
    share = np.clip(np.einsum("nkij,nkij->nki", relative, edges) / length, 0.0, 1.0)
    gap = relative - share[..., None] * edges
    best = np.einsum("nkij,nkij->nki", gap, gap).min(axis=2)
    normal = np.cross(edges[:, :, 0], edges[:, :, 1])
    square = np.maximum(np.einsum("nkj,nkj->nk", normal, normal), 1e-18)
    sides = np.einsum("nkij,nkj->nki", np.cross(edges, relative), normal)
    height = np.einsum("nkj,nkj->nk", relative[:, :, 0], normal)
    return np.where((sides >= 0).all(axis=2), np.minimum(best, height**2 / square), best)
