"""A guidewire as a Kirchhoff rod in a vessel of oriented points, with hard contacts and friction that holds: another
reality than the rod core's. Its wire, wall, contact and friction are laws of their own.

The rod is a discrete elastic rod (M. Bergou et al., ACM Trans. Graphics 27 (2008) 63 and 29 (2010) 116): curvature
binormals at the nodes, material frames by one angle an edge against frames that are carried along in time. Each time
step is one linearised minimisation, of a band matrix. Contacts bear what an augmented Lagrangian finds (P. Alart and A.
Curnier, Comput. Methods Appl. Mech. Eng. 92 (1991) 353): at rest nothing lies in the wall, and nothing creeps."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.linalg import get_blas_funcs, get_lapack_funcs
from scipy.optimize import brentq
from scipy.spatial import KDTree

from endopilot.devices.device import Wire
from endopilot.types import DistanceMap

NODE_MM = 0.8  # distance between nodes, mm; the sharpest bends of coronaries have a radius of some 3 mm
STEP_S = 0.01  # time step at most, s; with a tenth of that a push around a bend is the same to 3 %
BEHIND_MM = 3.0  # nodes farther behind the ostium follow the drive, mm
_STRETCH_N = 500.0  # EA at most, N: at 0.2 N a wire is 0.04 % shorter, and a step's second-order errors weigh less
_DRAG_N_S_MM2 = 1e-6  # of one mm of wire, N·s/mm²; 100 mm at 10 mm/s add 0.001 N
_POINTS_MM, _NEIGHBOURS = 0.15, 12  # between the wall's points, mm, and how many say where the wall is: to 0.002 mm
_BLOCK = 16  # voxels of a map that are looked at together, along each axis
_SHARPEST_1_MM = 2.0  # curvature across a vessel, 1/mm, at most: of one that a wire hardly enters
_PENALTY_N_MM = 10.0  # by which forces follow gaps and slips, N/mm; what is at rest does not depend on it
_TOLERANCE_MM, _ROUNDS = 1e-4, 40  # a step's contacts are solved until nodes move by less, mm, or so often
_DIRECT = 8  # rounds that go all the way; further ones search along it, or the sets that touch may go in circles
_LEAP_MM = 0.15  # a node that would move so much farther than the drive is damped more, as where the wire snaps, mm
_STRIDE_MM = 0.12  # advance in a step at most, mm, as of the fastest hand, 12 mm/s, in `STEP_S`
_MOST_DAMPING = 1e5  # times the drag: as stiff as what forces follow gaps by
_FAR_MM = 1e3  # from the wall is what follows the drive, mm
_solved: Any = get_lapack_funcs("pbsv", dtype=np.float64)  # of matrices as bands
_times: Any = get_blas_funcs("sbmv", dtype=np.float64)


class PointWall:
    """The inner surface of a vessel as oriented points, and between them their weighted planes (R. Kolluri, ACM Trans.
    Algorithms 4 (2008) 18)."""

    def __init__(self, field: DistanceMap) -> None:
        """Find the points where a distance map is zero, block by block: most of a map is far from the wall."""
        from scipy.ndimage import zoom
        from skimage.measure import marching_cubes

        finer, parts = max(1, round(field.spacing_mm / _POINTS_MM)), []
        corners = [range(0, size - 1, _BLOCK) for size in field.values.shape]
        for corner in itertools.product(*corners):
            block = field.values[tuple(slice(at, at + _BLOCK + 1) for at in corner)]
            if not block.min() < 0 < block.max():
                continue
            size = np.array(block.shape)
            fine = zoom(block, (finer * (size - 1) + 1) / size, order=1)
            points, _, normals, _ = marching_cubes(fine, 0.0, gradient_direction="ascent")
            parts.append((corner + points / finer, -normals))
        points, normals = (np.concatenate(part)[:, ::-1].astype(float) for part in zip(*parts, strict=True))
        self._points, self._normals = field.origin_mm + field.spacing_mm * points, normals
        self._tree = KDTree(self._points)

    def at(
        self, places: Float[np.ndarray, "n 3"], along: Float[np.ndarray, "n 3"]
    ) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n 3 3"], Float[np.ndarray, "n"]]:
        """Return how far inside the vessel places lie, mm, three axes there (the wall's normal into the vessel, that
        nearest to `along`, and around), and how fast the normal turns around, 1/mm."""
        far, index = self._tree.query(places, _NEIGHBOURS)
        weight = np.exp((far[:, :1] ** 2 - far**2) / _POINTS_MM**2)
        weight /= weight.sum(axis=1, keepdims=True)
        normals, off = self._normals[index], places[:, None] - self._points[index]
        depth = np.einsum("nk,nki,nki->n", weight, normals, off)
        normal = _unit(np.einsum("nk,nki->ni", weight, normals))
        axial = _unit(along - _dot(along, normal) * normal)
        around = _cross(axial, normal)
        beside = np.einsum("nki,ni->nk", off, around)
        bent = np.einsum("nk,nk,nki,ni->n", weight, beside, normals, around) / (weight * beside**2).sum(axis=1)
        return depth, np.stack([normal, axial, around], axis=1), bent


class _Contacts:
    """What the wall does to nodes in one time step; a row a node, whose numbers are its place and its edge's angle."""

    def __init__(self, rod: KirchhoffRod, begin: int, along: Float[np.ndarray, "n 3"]) -> None:
        """Look at the nodes from one on, of which two follow the drive; `along` are the wire's directions there."""
        depth, axes, bent = rod.wall.at(rod.position[begin:], along)
        self._gap, self._rows = depth - rod.radius_mm, np.zeros((len(depth), 3, 4))
        self._gap[:2] = _FAR_MM
        self._rows[:, :, :3] = axes  # off the wall, along the wire, and around it as it turns
        swing = np.sqrt(np.clip(bent, 0.0, _SHARPEST_1_MM))[:, None] * self._rows[:, 2]
        self._rows[:-1, 2, 3] = -rod.radius_mm
        self._pressed, self._rubbed, self._friction = rod.pressed[begin:], rod.rubbed[begin:], rod.friction
        # forces turn with the wall's normal as a wire swings to and fro
        self.turning = np.repeat(self._pressed, 4) * _banded(swing[:, None])
        self._bands = _banded(self._rows[:, :1]), _banded(self._rows[:, 1:])

    def forces(
        self, motion: Float[np.ndarray, "n 4"]
    ) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n 2"], Float[np.ndarray, "n"]]:
        """Return what presses on the nodes after a motion, N, what rubs on them along and around, N, and the latter's
        share of what would hold them."""
        return self._forces(np.einsum("nij,nj->ni", self._rows, motion))

    def _forces(
        self, off: Float[np.ndarray, "n 3"], limit: Float[np.ndarray, "n"] | None = None
    ) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n 2"], Float[np.ndarray, "n"]]:
        pressed = np.maximum(self._pressed - _PENALTY_N_MM * (self._gap + off[:, 0]), 0.0)
        holds = self._rubbed - _PENALTY_N_MM * off[:, 1:]
        most = self._friction * pressed if limit is None else limit
        share = np.minimum(1.0, most / (np.hypot(holds[:, 0], holds[:, 1]) + 1e-12))
        return pressed, share[:, None] * holds, share

    def keep_out(self, motion: Float[np.ndarray, "n 4"]) -> None:
        """Take from a motion what would enter the wall."""
        into = np.minimum(self._gap + _dot(self._rows[:, 0], motion)[:, 0], 0.0)
        motion -= into[:, None] * self._rows[:, 0]

    def solve(
        self, band: Float[np.ndarray, "11 m"], right: Float[np.ndarray, "m"], motion: Float[np.ndarray, "n 4"]
    ) -> Float[np.ndarray, "n 4"]:
        """Return the motion that balances the rod's forces and the wall's; `motion` is a guess at it."""
        free = slice(7, -1)
        for turn in range(_ROUNDS):
            off = np.einsum("nij,nj->ni", self._rows, motion)
            pressed, _, share = self._forces(off)
            touches, matrix = pressed > 0, band.copy()
            for factor, added in zip((touches, share), self._bands, strict=True):
                matrix[:4] += np.repeat(_PENALTY_N_MM * factor, 4) * added
            unmoved = touches * (self._pressed - _PENALTY_N_MM * self._gap)
            wall = np.concatenate([unmoved[:, None], share[:, None] * self._rubbed], axis=1)
            force = right + np.einsum("nk,nki->ni", wall, self._rows).ravel()
            _, found, failed = _solved(matrix[:, free], force[free], lower=1)
            way = np.zeros_like(motion)
            way.ravel()[free] = np.nan if failed else found - motion.ravel()[free]
            part = 1.0
            if turn >= _DIRECT and not failed:
                stiff = _times(10, 1.0, band[:, free], way.ravel()[free], lower=1)
                begin = stiff @ motion.ravel()[free] - right @ way.ravel()
                slope = float(begin), float(stiff @ way.ravel()[free])
                part = self._falls(slope, off, np.einsum("nij,nj->ni", self._rows, way), self._friction * pressed)
            motion = motion + part * way
            if not np.abs(way)[:, :3].max() > _TOLERANCE_MM:
                break
        return motion

    def _falls(
        self,
        rod: tuple[float, float],
        off: Float[np.ndarray, "n 3"],
        turn: Float[np.ndarray, "n 3"],
        limit: Float[np.ndarray, "n"],
    ) -> float:
        """Return the part of a way along which the energy falls, friction's limits being given. `rod` is the slope of
        its own part and how that grows; nodes have moved by `off` along their directions, and move by `turn`."""

        def slope(part: float) -> float:
            pressed, rubbed, _ = self._forces(off + part * turn, limit)
            return rod[0] + part * rod[1] - float(pressed @ turn[:, 0] + (rubbed * turn[:, 1:]).sum())

        if not slope(1.0) > -0.1 * slope(0.0) > 0:  # it falls, or nearly, all along
            return 1.0
        kink: Any = brentq(slope, 0.0, 1.0, xtol=1e-6)
        return kink + 1e-6  # beyond where a node begins to touch


class KirchhoffRod:
    """One wire that slides from a guiding catheter into a vessel; nodes count from the base."""

    def __init__(
        self,
        wall: PointWall,
        origin: Float[np.ndarray, "3"],
        axes: Float[np.ndarray, "3 3"],
        wire: Wire,
        length_mm: float,
    ) -> None:
        """Lay a wire out that may be inserted by some length from an origin, mm; `axes` has a column for each of its
        axes at rotation 0, the third along it."""
        self.wall, self.radius_mm, self._origin, self._axes = wall, wire.tip_radius_mm, origin, axes
        nodes = int(np.ceil((length_mm + BEHIND_MM) / NODE_MM)) + 4
        self.abscissa_mm = NODE_MM * np.arange(nodes)[::-1].astype(float)
        middle = self.abscissa_mm[:-1] - NODE_MM / 2
        self._stretch = np.minimum(16 * wire.bend_stiffness(middle) / wire.diameter_mm**2, _STRETCH_N)
        at = self.abscissa_mm[1:-1]
        bend, twist = wire.bend_stiffness(at), wire.twist_stiffness(at)
        self._stiffness = np.stack([bend, bend, twist], axis=1) / NODE_MM
        self._rest = np.zeros((nodes - 2, 3))
        self._limits = wire.push_limit_n, wire.pull_limit_n, wire.torque_limit_n_mm
        if wire.tip_bend_length_mm > 0:  # a node has the bend of half an edge to either side
            ends = np.clip(at + NODE_MM / 2 * np.array([[1], [-1]]), 0.0, wire.tip_bend_length_mm)
            self._rest[:, 0] = wire.tip_bend_rad / wire.tip_bend_length_mm * (ends[0] - ends[1])
        self.tip_force_n = np.zeros(3)
        self.reset(0.0, friction=0.0)

    def reset(self, rotation_rad: float, *, friction: float, inserted_mm: float = 0.0) -> None:
        """Put the wire straight into the catheter, its tip at the ostium, turned."""
        nodes = len(self.abscissa_mm)
        self.inserted_mm, self.rotation_rad, self.friction = inserted_mm, rotation_rad, friction
        self.position = self._origin + (inserted_mm - self.abscissa_mm)[:, None] * self._axes[:, 2]
        self._tangent = np.tile(self._axes[:, 2], (nodes - 1, 1))
        self._first = np.tile(self._axes[:, 0], (nodes - 1, 1))
        self._angle = np.full(nodes - 1, float(rotation_rad))
        self._turned = np.zeros(nodes - 2)
        self.pressed, self.rubbed = np.zeros(nodes), np.zeros((nodes, 2))
        self._last, self._damping = np.zeros((nodes, 4)), 1.0
        self.load = (0.0, 0.0)

    def drive(self, velocity: Sequence[float], seconds: float) -> None:
        """Move the base for some time, mm/s and rad/s, except where the drive slips rather than push, pull or turn
        harder than the wire's limits. A wire that is no longer finite stays."""
        steps = max(1, int(np.ceil(max(seconds / STEP_S, abs(velocity[0]) * seconds / _STRIDE_MM) - 1e-9)))
        advance, turn = (each * seconds / steps for each in velocity)
        push, pull, twist = self._limits
        for _ in range(steps):
            force, torque = self.load
            slips = force * np.sign(advance) > (push if advance > 0 else pull)
            turns = torque * np.sign(turn) <= twist
            self._step(0.0 if slips else advance, turn if turns else 0.0, seconds / steps)
            if not np.isfinite(self.position).all():
                return

    @property
    def frames(self) -> Float[np.ndarray, "edges 3 3"]:
        """The edges' material axes as columns, the third along the wire."""
        second = _cross(self._tangent, self._first)
        cos, sin = np.cos(self._angle)[:, None], np.sin(self._angle)[:, None]
        return np.stack([cos * self._first + sin * second, cos * second - sin * self._first, self._tangent], axis=2)

    def _step(self, advance: float, turn: float, dt: float) -> None:
        self.inserted_mm += advance
        ahead = self.inserted_mm - self.abscissa_mm
        held = min(max(int(np.searchsorted(ahead, -BEHIND_MM)), 2), len(ahead) - 4)
        self._turned[held - 2] += self.rotation_rad - self._angle[held - 2]  # of an edge that is taken back
        self.rotation_rad += turn
        self.position[:held] = self._origin + ahead[:held, None] * self._axes[:, 2]
        self._first[: held - 1], self._angle[: held - 1] = self._axes[:, 0], self.rotation_rad
        self._tangent[: held - 1] = self._axes[:, 2]
        self._turned[: held - 2] = 0.0
        self.pressed[:held] = self.rubbed[:held] = 0.0
        begin = held - 2
        self._carry(begin)
        slope, band = self._elastic(begin)
        slope[-4:-1] -= self.tip_force_n
        along = self._tangent[begin:][[*range(len(self._tangent) - begin), -1]]
        contacts = _Contacts(self, begin, along)
        carried = np.concatenate([advance * along, np.full((len(along), 1), turn)], axis=1)  # by the drive alone
        contacts.keep_out(carried)
        drag = _DRAG_N_S_MM2 * NODE_MM / dt * np.tile([1.0, 1.0, 1.0, self.radius_mm**2], len(along))
        motion, leap = self._last[begin:], np.inf
        while leap > _LEAP_MM:
            damped = band.copy()
            damped[0] += self._damping * drag
            damped[:4] += contacts.turning
            motion = contacts.solve(damped, self._damping * drag * carried.ravel() - slope, motion)
            leap = float(np.abs(motion[2:, :3]).max()) - abs(advance) if self._damping < _MOST_DAMPING else 0.0
            self._damping *= 4.0 if leap > _LEAP_MM else 0.5
        self._damping = max(1.0, self._damping)
        self.pressed[begin:], self.rubbed[begin:], _ = contacts.forces(motion)
        self._last[begin:] = motion
        # the energy's slope at what follows the drive, once the others have moved
        held_by = [slope[k] + band[7 - k :, k] @ motion.ravel()[7 : k + 11] for k in range(7)]
        self.load = float((np.array(held_by[:3]) + held_by[4:7]) @ self._axes[:, 2]), float(held_by[3])
        self.position[begin:] += motion[:, :3]
        self._angle[begin:] += motion[:-1, 3]
        self._carry(begin)

    def _carry(self, begin: int) -> None:
        """Carry edges' frames along to where the edges point now."""
        now = _unit(np.diff(self.position[begin:], axis=0))
        first = _transport(self._first[begin:], self._tangent[begin:], now)
        self._first[begin:], self._tangent[begin:] = _unit(first - _dot(first, now) * now), now

    def _elastic(self, begin: int) -> tuple[Float[np.ndarray, "m"], Float[np.ndarray, "11 m"]]:
        """Return the elastic energy's slope, N or N·mm, and its Gauss-Newton matrix as bands, by nodes' places and the
        angle of the edge behind each: x y z angle, x y z angle, ..."""
        edges, nodes = np.diff(self.position[begin:], axis=0), len(self.position) - begin
        size = np.linalg.norm(edges, axis=1)[:, None]
        m1, m2, tangent = np.moveaxis(self.frames[begin:], 2, 0)
        e, f, first, edge_1, edge_2 = tangent[:-1], tangent[1:], self._first[begin:], 1 / size[:-1], 1 / size[1:]
        chi = 1 + _dot(e, f)
        binormal = 2 * _cross(e, f) / chi
        over = _transport(first[:-1], e, f)
        turned = np.arctan2(_dot(_cross(over, first[1:]), f), _dot(over, first[1:]))[:, 0]  # of the frames themselves
        before = self._turned[begin:]
        self._turned[begin:] = turned = before + np.mod(turned - before + np.pi, 2 * np.pi) - np.pi
        by = np.zeros((len(e), 3, 11))  # strains' derivatives: the node before, its edge, the node, its edge, the next
        strain = np.stack([*np.zeros((2, len(e))), np.diff(self._angle[begin:]) + turned], axis=1)
        for axis, (m, other) in enumerate(((m1, m2), (m2, -m1))):
            mean, bend = (m[:-1] + m[1:]) / chi, 0.5 * _dot(binormal, m[:-1] + m[1:])
            strain[:, axis] = bend[:, 0]
            by_e = (_cross(f, mean) - bend * (e + f) / chi) * edge_1
            by_f = (-_cross(e, mean) - bend * (e + f) / chi) * edge_2
            by[:, axis, :3], by[:, axis, 4:7], by[:, axis, 8:] = -by_e, by_e - by_f, by_f
            by[:, axis, 3:8:4] = 0.5 * np.concatenate([_dot(binormal, other[:-1]), _dot(binormal, other[1:])], axis=1)
        by_e, by_f = 0.5 * binormal * edge_1, 0.5 * binormal * edge_2
        by[:, 2, :3], by[:, 2, 4:7], by[:, 2, 8:], by[:, 2, 3:8:4] = -by_e, by_e - by_f, by_f, (-1.0, 1.0)
        stiff = self._stiffness[begin:, :, None] * by
        slope, band = np.zeros(4 * nodes), np.zeros((11, 4 * nodes))
        _add(slope, band, np.einsum("nk,nkj->nj", strain - self._rest[begin:], stiff), by.swapaxes(1, 2) @ stiff)
        # a stretched edge is stiff across, too; what a pushed one lacks there is left out, as of every softening
        pull = self._stretch[begin:, None] * (size / NODE_MM - 1)
        across = (np.maximum(pull, 0.0) / size)[:, :, None] * np.eye(3)
        along = (self._stretch[begin:, None] / NODE_MM - np.maximum(pull, 0.0) / size)[:, :, None]
        stiff = across + along * tangent[:, :, None] * tangent[:, None]
        ends = np.eye(7)[:, :3] - np.eye(7)[:, 4:]  # of a part's numbers
        _add(slope, band, -pull * tangent @ ends.T, ends @ stiff @ ends.T)
        return slope, band


def _add(
    slope: Float[np.ndarray, "m"],
    band: Float[np.ndarray, "11 m"],
    slopes: Float[np.ndarray, "parts numbers"],
    squares: Float[np.ndarray, "parts numbers numbers"],
) -> None:
    """Add slopes and symmetric matrices of parts, each of which begins at the next node's numbers."""
    parts, numbers = slopes.shape
    begin, (rows, columns) = 4 * np.arange(parts)[:, None], np.tril_indices(numbers)
    slope += np.bincount((begin + np.arange(numbers)).ravel(), slopes.ravel(), len(slope))
    at = (rows - columns) * len(slope) + columns + begin
    band += np.bincount(at.ravel(), squares[:, rows, columns].ravel(), band.size).reshape(band.shape)


def _banded(rows: Float[np.ndarray, "n k 4"]) -> Float[np.ndarray, "4 m"]:
    """Return the sums of the rows' squares of each node as bands of a lower matrix."""
    squares, band = np.einsum("nki,nkj->nij", rows, rows), np.zeros((4, len(rows), 4))
    for below in range(4):
        band[below, :, : 4 - below] = np.diagonal(squares, -below, 1, 2)
    return band.reshape(4, -1)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / (np.linalg.norm(vectors, axis=1, keepdims=True) + 1e-12)


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the products of rows, as a column."""
    return np.einsum("ni,ni->n", a, b)[:, None]


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return cross products of rows; `numpy.cross` takes three times as long."""
    return a[:, [1, 2, 0]] * b[:, [2, 0, 1]] - a[:, [2, 0, 1]] * b[:, [1, 2, 0]]


def _transport(vectors: np.ndarray, before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Return vectors turned as the shortest turn takes one unit vector to another."""
    axis = _cross(before, after)
    cos = _dot(before, after)
    return cos * vectors + _cross(axis, vectors) + axis * _dot(axis, vectors) / (1 + cos)
