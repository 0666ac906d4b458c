"""A guidewire as a Kirchhoff rod in a vessel of oriented points, with hard contacts and friction that holds: another
reality than the rod core's. Its wire, wall, contact and friction are laws of their own.

The rod is a discrete elastic rod (M. Bergou et al., ACM Trans. Graphics 27 (2008) 63 and 29 (2010) 116): curvature
binormals at the nodes, material frames by one angle an edge against frames that are carried along in time. Each time step
is one linearised minimisation, of a band matrix. Contacts bear what an augmented Lagrangian finds (P. Alart and A.
Curnier, Comput. Methods Appl. Mech. Eng. 92 (1991) 353): at rest nothing lies in the wall, and nothing creeps."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from scipy.linalg.lapack import dpbsv
from scipy.spatial import KDTree

from endopilot.devices.device import Wire
from endopilot.types import DistanceMap, Insertion

NODE_MM = 0.8  # distance between nodes, mm; the sharpest bends of coronaries have a radius of some 3 mm
STEP_S = 0.01  # time step at most, s
STRETCH_N = 500.0  # EA at most, N: at 0.2 N a wire is 0.04 % shorter
BEHIND_MM = 3.0  # nodes farther behind the ostium follow the drive, mm
POINTS_MM = 0.15  # distance between the wall's points, mm
SHARPEST_1_MM = 2.0
BLOCK = 16  # voxels of the map that are looked at together, along each axis
NEIGHBOURS = 12  # points that a place on the wall is found from
PENALTY_N_MM = 10.0  # by which multipliers follow gaps and slips, N/mm; what is at rest does not depend on it
TOLERANCE_MM = 1e-3  # nodes move by less between two rounds of a time step's contacts, mm
ROUNDS = 20  # at most; multipliers go on in the next step
LEAP_MM = 0.15  # a node that would move farther beside the drive's motion is damped more, as where the wire snaps, mm
MOST_DAMPING = 1e8
DRAG_N_S_MM2 = 1e-6  # of one mm of wire, N·s/mm²; 100 mm at 10 mm/s add 0.001 N


ROUND=[0]
class PointWall:
    """The inner surface of a vessel as oriented points, and between them their weighted planes (R. Kolluri, ACM Trans.
    Algorithms 4 (2008) 18)."""

    def __init__(self, field: DistanceMap) -> None:
        """Find the points where a distance map is zero, block by block: most of a map is far from the wall."""
        from scipy.ndimage import zoom
        from skimage.measure import marching_cubes

        finer, parts = max(1, round(field.spacing_mm / POINTS_MM)), []
        corners = [range(0, size - 1, BLOCK) for size in field.values.shape]
        for corner in itertools.product(*corners):
            block = field.values[tuple(slice(at, at + BLOCK + 1) for at in corner)]
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
        far, index = self._tree.query(places, NEIGHBOURS)
        weight = np.exp((far[:, :1] ** 2 - far**2) / POINTS_MM**2)
        weight /= weight.sum(axis=1, keepdims=True)
        normals, off = self._normals[index], places[:, None] - self._points[index]
        depth = np.einsum("nk,nki,nki->n", weight, normals, off)
        normal = _unit(np.einsum("nk,nki->ni", weight, normals))
        axial = _unit(along - np.einsum("ni,ni->n", along, normal)[:, None] * normal)
        around = _cross(axial, normal)
        beside = np.einsum("nki,ni->nk", off, around)
        bent = np.einsum("nk,nk,nki,ni->n", weight, beside, normals, around) / (weight * beside**2).sum(axis=1)
        return depth, np.stack([normal, axial, around], axis=1), bent


class _Contacts:
    """What the wall does to nodes in one time step; a row a node. `rows` are directions in a node's place and its edge's
    angle: off the wall, along the wire and around it; `bent` is how fast the wall's normal turns around, 1/mm; `pressed`
    and `rubbed` are the forces before, N."""

    def __init__(
        self,
        gap: Float[np.ndarray, "n"],
        rows: Float[np.ndarray, "n 3 4"],
        bent: Float[np.ndarray, "n"],
        pressed: Float[np.ndarray, "n"],
        rubbed: Float[np.ndarray, "n 2"],
        friction: float,
    ) -> None:
        self.gap, self.rows, self._friction = gap, rows, friction
        self._pressed, self._rubbed = pressed, rubbed
        swing = np.sqrt(np.clip(bent, 0.0, SHARPEST_1_MM))[:, None] * rows[:, 2, :3]  # the force turns with its normal
        self._bands = _banded(rows[:, :1]), _banded(rows[:, 1:]), _banded(np.pad(swing, ((0, 0), (0, 1)))[:, None])
        self._right = rows[:, 0], np.einsum("nk,nki->ni", rubbed, rows[:, 1:])

    def forces(self, motion: Float[np.ndarray, "n 4"]) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n 2"]]:
        """Return what presses on the nodes after a motion, and rubs along and around, N: the augmented Lagrangian's."""
        off = np.einsum("nij,nj->ni", self.rows, motion)
        bears = np.maximum(self._pressed - PENALTY_N_MM * (self.gap + off[:, 0]), 0.0)
        rubs = self._rubbed - PENALTY_N_MM * off[:, 1:]
        self._share = np.minimum(1.0, self._friction * bears / (np.hypot(rubs[:, 0], rubs[:, 1]) + 1e-12))
        return bears, self._share[:, None] * rubs

    def solve(
        self, band: Float[np.ndarray, "11 m"], damped: Float[np.ndarray, "m"], right: Float[np.ndarray, "m"], motion: Float[np.ndarray, "n 4"]
    ) -> Float[np.ndarray, "n 4"]:
        """Return the motion that balances slopes and the wall's forces; `motion` is a guess at it."""
        for _ in range(ROUNDS):
            bears, _ = self.forces(motion)
            touches = (bears > 0).astype(float)
            matrix = band.copy()
            for factor, added in zip((PENALTY_N_MM * touches, PENALTY_N_MM * self._share, bears), self._bands, strict=True):
                matrix[:4] += np.repeat(factor, 4) * added
            matrix[0] += damped
            load = touches * (self._pressed - PENALTY_N_MM * self.gap)
            force = right + (load[:, None] * self._right[0] + self._share[:, None] * self._right[1]).ravel()
            before, motion = motion, np.zeros_like(motion)
            _, found, failed = dpbsv(matrix[:, 7:-1], force[7:-1], lower=1)
            motion.reshape(-1)[7:-1] = np.nan if failed else found
            ROUND[0]+=1
            if not np.abs(motion - before)[:, :3].max() > TOLERANCE_MM:
                break
        return motion


class KirchhoffRod:
    """One wire that slides from a guiding catheter into a vessel; nodes count from the base."""

    def __init__(self, wall: PointWall, insertion: Insertion, axes: Float[np.ndarray, "3 3"], wire: Wire, length_mm: float) -> None:
        """Lay a wire out that may be inserted by some length; `axes` has a column for each of its axes at rotation 0."""
        self.wall, self._wire = wall, wire
        self._origin, self._axes = np.asarray(insertion.position, dtype=float), axes
        nodes = int(np.ceil((length_mm + BEHIND_MM) / NODE_MM)) + 4
        self.abscissa_mm = NODE_MM * np.arange(nodes)[::-1].astype(float)
        middle = self.abscissa_mm[:-1] - NODE_MM / 2
        self._stretch = np.minimum(16 * wire.bend_stiffness(middle) / wire.diameter_mm**2, STRETCH_N)
        at = self.abscissa_mm[1:-1]
        bend, twist = wire.bend_stiffness(at), wire.twist_stiffness(at)
        self._stiffness = np.stack([bend, bend, twist], axis=1) / NODE_MM
        self._rest = np.zeros((nodes - 2, 3))
        length = wire.tip_bend_length_mm
        if length > 0:
            # the bend from half an edge before the node to half an edge behind it; the first has the tip's half edge too
            ends = np.minimum(np.maximum(np.stack([at - NODE_MM / 2, at + NODE_MM / 2]), 0.0), length)
            self._rest[:, 0] = wire.tip_bend_rad / length * (ends[1] - ends[0])
        self.tip_force_n = np.zeros(3)
        self.rounds=0
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
        self.pressed, self._rubbed = np.zeros(nodes), np.zeros((nodes, 2))
        self._last, self._damping = np.zeros((nodes, 4)), 1.0
        self.load = (0.0, 0.0)

    def drive(
        self, velocity: tuple[float, float], seconds: float, *, limits: Sequence[float] = (np.inf, np.inf, np.inf)
    ) -> tuple[float, float]:
        """Move the base for some time, mm/s and rad/s; return the advance (mm) and the rotation (rad) that slipped, where
        it would have pushed, pulled (N) or turned (N·mm) harder than the limits."""
        steps = max(1, int(np.ceil(seconds / STEP_S - 1e-9)))
        advance, turn = velocity[0] * seconds / steps, velocity[1] * seconds / steps
        slipped, turned = 0, 0
        for _ in range(steps):
            force, torque = self.load
            slips = force * np.sign(advance) > (limits[0] if advance > 0 else limits[1])
            whirls = torque * np.sign(turn) > limits[2]
            self._step(0.0 if slips else advance, 0.0 if whirls else turn, seconds / steps)
            slipped, turned = slipped + slips, turned + whirls
        return slipped * advance, turned * turn

    @property
    def frames(self) -> Float[np.ndarray, "edges 3 3"]:
        """The edges' material axes as columns, the third along the wire."""
        second = _cross(self._tangent, self._first)
        cos, sin = np.cos(self._angle)[:, None], np.sin(self._angle)[:, None]
        return np.stack([cos * self._first + sin * second, cos * second - sin * self._first, self._tangent], axis=2)

    def _step(self, advance: float, turn: float, dt: float) -> None:
        self.inserted_mm += advance
        ahead = self.inserted_mm - self.abscissa_mm
        held = min(max(int(np.searchsorted(ahead, -BEHIND_MM)), 2), len(ahead) - 2)
        self._turned[held - 2] += self.rotation_rad - self._angle[held - 2]  # of an edge that is taken back
        self.rotation_rad += turn
        self.position[:held] = self._origin + ahead[:held, None] * self._axes[:, 2]
        self._first[: held - 1], self._angle[: held - 1] = self._axes[:, 0], self.rotation_rad
        self._tangent[: held - 1] = self._axes[:, 2]
        self._turned[: held - 2] = 0.0
        self.pressed[:held] = self._rubbed[:held] = 0.0
        begin = held - 2
        slope, band = self._elastic(begin)
        contacts = self._contacts(begin)
        drag = DRAG_N_S_MM2 * NODE_MM / dt * np.array([1.0, 1.0, 1.0, self._wire.tip_radius_mm**2])
        carried = np.zeros((len(contacts.gap), 4))  # what the drive alone would move
        carried[:, :3], carried[:-1, 3] = advance * contacts.rows[:, 1, :3], turn
        slope[-4:-1] -= self.tip_force_n
        motion, leap = self._last[begin:], np.inf
        while leap > LEAP_MM:
            damped = np.tile(self._damping * drag, len(carried))
            motion = contacts.solve(band, damped, damped * carried.ravel() - slope, motion)
            leap = float(np.abs(motion - carried)[2:, :3].max()) if self._damping < MOST_DAMPING else 0.0
            self._damping *= 4.0 if leap > LEAP_MM else 0.5
        self._damping = max(1.0, self._damping)
        self.pressed[begin:], self._rubbed[begin:] = contacts.forces(motion)
        self._last[begin:] = motion
        self._load(slope, band, motion.ravel())
        self.position[begin:] += motion[:, :3]
        self._angle[begin:] += motion[:-1, 3]
        self._carry(begin)

    def _contacts(self, begin: int) -> _Contacts:
        along = self._tangent[begin:][np.append(np.arange(len(self._tangent) - begin), -1)]
        gap, axes, bent = self.wall.at(self.position[begin:], along)
        rows = np.zeros((len(gap), 3, 4))
        rows[:, :, :3] = axes
        rows[:-1, 2, 3] = -self._wire.tip_radius_mm
        gap -= self._wire.tip_radius_mm
        gap[:2] = 1e3  # these follow the drive
        return _Contacts(gap, rows, bent, self.pressed[begin:], self._rubbed[begin:], self.friction)

    def _load(self, slope: np.ndarray, band: np.ndarray, motion: np.ndarray) -> None:
        """Keep the force and the torque that hold the base: the slope of the energy there after the motion."""
        reach = len(band)
        full = slope[:7].copy()
        for column in range(7):
            for below in range(reach):
                row = column + below
                if row < len(motion):
                    full[column] += band[below, column] * motion[row]
                    if below and row < 7:
                        full[row] += band[below, column] * motion[column]
        force = full[:3] + full[4:7]
        self.load = (float(force @ self._axes[:, 2]), float(full[3]))

    def _carry(self, begin: int) -> None:
        """Carry the edges' frames along to where the edges point now, and see how far they turn against each other."""
        edge = np.diff(self.position[begin:], axis=0)
        now = edge / np.linalg.norm(edge, axis=1, keepdims=True)
        first = _transport(self._first[begin:], self._tangent[begin:], now)
        first -= np.einsum("ni,ni->n", first, now)[:, None] * now
        self._first[begin:] = first / np.linalg.norm(first, axis=1, keepdims=True)
        self._tangent[begin:] = now

    def _elastic(self, begin: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the elastic energy's slope, N or N·mm, and its Gauss-Newton matrix as bands, by nodes' places and the
        angle of the edge behind each: x y z angle, x y z angle, ..."""
        position, angle = self.position[begin:], self._angle[begin:]
        edges = np.diff(position, axis=0)
        size = np.linalg.norm(edges, axis=1)
        tangent = edges / size[:, None]
        d1 = self._first[begin:]
        d2 = _cross(tangent, d1)
        cos, sin = np.cos(angle)[:, None], np.sin(angle)[:, None]
        m1, m2 = cos * d1 + sin * d2, cos * d2 - sin * d1
        e, f = tangent[:-1], tangent[1:]
        chi = 1 + np.einsum("ni,ni->n", e, f)[:, None]
        binormal = 2 * _cross(e, f) / chi
        # twist of the frames that are carried along
        over = _transport(d1[:-1], e, f)
        turned = np.arctan2(np.einsum("ni,ni->n", _cross(over, d1[1:]), f), np.einsum("ni,ni->n", over, d1[1:]))
        before = self._turned[begin:]
        self._turned[begin:] = turned = before + np.mod(turned - before + np.pi, 2 * np.pi) - np.pi
        strain = np.stack(
            [
                0.5 * np.einsum("ni,ni->n", binormal, m1[:-1] + m1[1:]),
                0.5 * np.einsum("ni,ni->n", binormal, m2[:-1] + m2[1:]),
                np.diff(angle) + turned,
            ],
            axis=1,
        )
        middle = (e + f) / chi
        by = np.zeros((len(e), 3, 11))  # derivative of strains by the node before, its edge, the node, its edge, ...
        for k, m in enumerate((m1, m2)):
            mean = (m[:-1] + m[1:]) / chi
            by_e = (-strain[:, k, None] * middle + _cross(f, mean)) / size[:-1, None]
            by_f = (-strain[:, k, None] * middle - _cross(e, mean)) / size[1:, None]
            by[:, k, :3], by[:, k, 4:7], by[:, k, 8:] = -by_e, by_e - by_f, by_f
            other, sign = (m2, 0.5) if k == 0 else (m1, -0.5)
            by[:, k, 3] = sign * np.einsum("ni,ni->n", binormal, other[:-1])
            by[:, k, 7] = sign * np.einsum("ni,ni->n", binormal, other[1:])
        by_e, by_f = 0.5 * binormal / size[:-1, None], 0.5 * binormal / size[1:, None]
        by[:, 2, :3], by[:, 2, 4:7], by[:, 2, 8:], by[:, 2, 3], by[:, 2, 7] = -by_e, by_e - by_f, by_f, -1.0, 1.0
        stiffness, apart = self._stiffness[begin:], strain - self._rest[begin:]
        stiff_by = stiffness[:, :, None] * by
        slopes = np.einsum("nk,nkj->nj", apart, stiff_by)
        blocks = by.transpose(0, 2, 1) @ stiff_by
        # stretch
        stretch = self._stretch[begin:]
        tension = stretch * (size / NODE_MM - 1)
        pull = tension[:, None] * tangent
        across = np.maximum(tension, 0.0) / size
        axial = (stretch / NODE_MM - across)[:, None, None] * tangent[:, :, None] * tangent[:, None, :]
        axial[:, range(3), range(3)] += across[:, None]
        nodes = len(position)
        slope = np.zeros((nodes, 4))
        for part in range(3):
            width = 4 if part < 2 else 3
            slope[part : part + len(e), :width] += slopes[:, 4 * part : 4 * part + width]
        slope[:-1, :3] -= pull
        slope[1:, :3] += pull
        band = np.zeros((11, 4 * nodes))
        rows, columns = np.tril_indices(11)
        start = 4 * np.arange(len(e))[:, None]
        flat = (rows - columns) * (4 * nodes) + columns + start
        band += np.bincount(flat.ravel(), blocks[:, rows, columns].ravel(), minlength=band.size).reshape(band.shape)
        for row in range(3):
            for column in range(3):
                if column <= row:
                    band[row - column, column : 4 * nodes - 4 : 4] += axial[:, row, column]
                    band[row - column, 4 + column :: 4] += axial[:, row, column]
                band[4 + row - column, column : 4 * nodes - 4 : 4] -= axial[:, row, column]
        return slope.ravel(), band


def _banded(rows: Float[np.ndarray, "n k 4"]) -> Float[np.ndarray, "4 m"]:
    """Return the sums of the rows' squares of each node as bands of a lower matrix."""
    squares, band = np.einsum("nki,nkj->nij", rows, rows), np.zeros((4, len(rows), 4))
    for below in range(4):
        band[below, :, : 4 - below] = np.diagonal(squares, -below, 1, 2)
    return band.reshape(4, -1)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / (np.linalg.norm(vectors, axis=1, keepdims=True) + 1e-12)


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return cross products of rows; `numpy.cross` takes three times as long."""
    return a[:, [1, 2, 0]] * b[:, [2, 0, 1]] - a[:, [2, 0, 1]] * b[:, [1, 2, 0]]


def _transport(vectors: np.ndarray, before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Return vectors turned as the shortest turn takes one unit vector to another."""
    axis = _cross(before, after)
    cos = np.einsum("ni,ni->n", before, after)[:, None]
    return cos * vectors + _cross(axis, vectors) + axis * np.einsum("ni,ni->n", axis, vectors)[:, None] / (1 + cos)
