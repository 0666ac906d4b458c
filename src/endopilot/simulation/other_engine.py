"""A wire in a vessel by another engine, MuJoCo: rigid links with sprung joints, and contacts of its own.

The rod core shares nothing with it but the wire's stiffnesses, the lumen's surface and the coefficient of friction. Its
joints get an inertia and a damping of their own by which all come to rest alike, in some hundredths of a second: a wire
moves as slowly as if it had neither.
"""

from __future__ import annotations

import importlib
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from endopilot.anatomy.distance import sample
from endopilot.extras import extra_named
from endopilot.simulation.core import insertion_arguments
from endopilot.simulation.rod import RodLayout
from endopilot.types import Anatomy, DistanceMap, Insertion

STEP_S = 0.002
"""Time step of MuJoCo, s."""
SETTLE_S = 0.06
"""Time in which the joints come to rest, s. Velocities are taken away after each step, so that an inertia of stiffness
times this and the step damps a joint, in the equations that contacts solve too, and nothing swings."""
SHELL_MM = 0.4
"""Thickness of the wall's triangles, mm: they lie so far outside the lumen. A thinner wall lets a node through."""
MESH_MM = 0.4
"""Spacing of the grid that the wall's triangles are found on, mm."""
BEHIND_MM = 3.0
"""Joints farther behind the ostium are held straight, mm; no wall is needed there."""
LEAP_MM = 0.1
"""A node that would move farther in a step is damped more, as where the wire snaps over, mm."""
_SLOWEST = 256
_HELD = 1e3
"""Inertia of a joint that is held, N·mm·s²."""
_BASE_INERTIA = 1e6
"""Of the base, which follows the drive, N·s²/mm and N·mm·s²."""


class EngineWire:
    """One wire in MuJoCo, from a base that follows a drive to its tip.

    Attributes:
        inserted_mm: length ahead of the ostium, mm.
        rotation_rad: of the base, rad.
    """

    def __init__(self, anatomy: Anatomy, rod: RodLayout) -> None:
        """Lay the wire out straight on the guiding catheter's axis, its tip at the ostium.

        Args:
            anatomy: the vessel.
            rod: nodes and stiffnesses.

        Raises:
            ModuleNotFoundError: MuJoCo is not installed; the message says how it is.
        """
        with extra_named("engine: mujoco"):
            self._mujoco: Any = importlib.import_module("mujoco")
        wall = wall_triangles(anatomy.distance_map, anatomy.insertion, 2 * anatomy.catheter_radius_mm)
        self._model = self._mujoco.MjModel.from_xml_string(_model(wall, rod, anatomy.insertion))
        self._model.dof_armature[:2] = _BASE_INERTIA
        self._data = self._mujoco.MjData(self._model)
        self._inertia = self._model.dof_armature.copy()
        self._at = np.repeat(rod.abscissa_mm[-2:0:-1], 3)  # of each joint's hinges, mm from the tip
        self.reset(0.0, friction=0.0)

    def reset(self, rotation_rad: float, *, friction: float) -> None:
        """Put the wire's tip to the ostium, the wire straight and turned; friction is its coefficient on the wall."""
        self._mujoco.mj_resetData(self._model, self._data)
        self._model.geom_friction[:, 0] = friction
        self.inserted_mm, self.rotation_rad = 0.0, rotation_rad
        self._data.qpos[1] = rotation_rad
        self._slow = 1.0
        self._held = np.zeros(len(self._at), dtype=bool)
        self._hold()
        self._mujoco.mj_forward(self._model, self._data)

    def drive(self, velocity: tuple[float, float], seconds: float) -> None:
        """Move the base for some time, mm/s and rad/s."""
        data, model = self._data, self._model
        steps = max(1, round(seconds / STEP_S))
        for _ in range(steps):
            self._hold()
            data.qpos[:2] = self.inserted_mm, self.rotation_rad
            data.qpos[2:][self._held] *= 1 - STEP_S / SETTLE_S
            before, nodes = data.qpos.copy(), self._data.geom_xpos.copy()
            while True:
                model.dof_armature[2:] = np.where(self._held, _HELD, self._slow * self._inertia[2:])
                data.qpos[:], data.qvel[:2], data.qvel[2:] = before, velocity, 0.0
                self._mujoco.mj_step(model, data)
                self._mujoco.mj_kinematics(model, data)
                leap = float(np.linalg.norm(data.geom_xpos - nodes, axis=1).max())
                if leap <= LEAP_MM or self._slow >= _SLOWEST:
                    break
                self._slow *= 2
            self._slow = max(1.0, 0.7 * self._slow)
            self.inserted_mm += velocity[0] * seconds / steps
            self.rotation_rad += velocity[1] * seconds / steps

    def _hold(self) -> None:
        """Hold the joints straight that are behind the ostium; the softness of contacts follows from what is free."""
        held = self.inserted_mm - self._at < -BEHIND_MM
        if (held == self._held).all():
            return
        self._held, model = held, self._model
        model.dof_armature[2:] = np.where(held, _HELD, self._inertia[2:])
        kept = self._data.qpos.copy(), self._data.qvel.copy()
        self._mujoco.mj_setConst(model, self._data)
        model.stat.meaninertia = float(np.median(self._inertia[2:]))
        self._data.qpos[:], self._data.qvel[:] = kept

    @property
    def load(self) -> tuple[float, float]:
        """Force (N) and torque (N·mm) that the drive pushes and turns with."""
        force, torque = (-(self._data.qfrc_constraint[:2] + self._data.qfrc_passive[:2])).tolist()
        return force, torque

    @property
    def nodes(self) -> tuple[Float[np.ndarray, "nodes 3"], Float[np.ndarray, "nodes 4"]]:
        """Where the nodes lie from the tip on, LPS mm, and quaternions w x y z of the elements behind them."""
        return self._data.geom_xpos[:0:-1].copy(), self._data.xquat[:1:-1].copy()

    @property
    def pressed(self) -> Float[np.ndarray, "nodes"]:
        """Force of the wall on each node, from the tip on, N."""
        data, model = self._data, self._model
        force, found = np.zeros(6), np.zeros(model.ngeom)
        for index in range(data.ncon):
            self._mujoco.mj_contactForce(model, data, index, force)
            found[max(data.contact.geom[index])] += force[0]
        return found[:0:-1]


def wall_triangles(
    field: DistanceMap, insertion: Insertion, clear_mm: float
) -> tuple[Float[np.ndarray, "n 3"], Int[np.ndarray, "m 3"]]:
    """Return the surface `SHELL_MM` outside a lumen, LPS mm, without the guiding catheter behind the ostium.

    Args:
        field: of the vessel with its catheter.
        insertion: the ostium.
        clear_mm: no triangle stays this near to the catheter's axis.
    """
    from skimage.measure import marching_cubes

    extent = (np.array(field.values.shape[::-1]) - 1) * field.spacing_mm
    axes = [np.arange(0.0, size + 1e-9, MESH_MM) for size in extent]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    values = sample(field, (field.origin_mm + grid.reshape(-1, 3)), order=1).reshape(grid.shape[:3])
    points, faces, _, _ = marching_cubes(values, -SHELL_MM)
    points = field.origin_mm + MESH_MM * points
    off = points - insertion.position
    along = off @ insertion.direction
    behind = (along < -2 * BEHIND_MM) & (np.linalg.norm(off - along[:, None] * insertion.direction, axis=1) < clear_mm)
    faces = faces[~behind[faces].any(axis=1)]
    used, faces = np.unique(faces, return_inverse=True)
    return points[used], faces.reshape(-1, 3)


def _model(wall: tuple[np.ndarray, np.ndarray], rod: RodLayout, insertion: Insertion) -> str:
    """Return MuJoCo's model: the wall, and links along z from the base to the tip, with three hinges at each joint."""
    points, faces = wall
    base = insertion_arguments(insertion)
    lengths = np.diff(rod.abscissa_mm)
    count = len(lengths)
    start = base["origin"] - float(rod.abscissa_mm[-1]) * np.asarray(insertion.direction)
    bodies = []
    for joint in range(count - 1, -1, -1):  # the link from node joint + 1 to node joint
        node, size = joint + 1, float(lengths[joint])
        width = 0.5 * (size + (float(lengths[node]) if node < count else size))
        hinges = ""
        if node < count:
            stiffness = np.array([rod.bend_n_mm2[node]] * 2 + [rod.twist_n_mm2[node]]) / width
            rest = rod.rest_curvature[node] * width
            hinges = "".join(
                f'<joint type="hinge" axis="{axis}" stiffness="{k}" springref="{np.rad2deg(angle)}" '
                f'armature="{k * SETTLE_S * STEP_S}"/>'
                for axis, k, angle in zip(("1 0 0", "0 1 0", "0 0 1"), stiffness, rest, strict=True)
            )
        place = f'pos="0 0 {lengths[node]}"' if node < count else ""
        sphere = f'<geom type="sphere" size="{rod.radius_mm[joint]}" pos="0 0 {size}" mass="0"/>'
        bodies.append(
            f'<body {place}>{hinges}<inertial pos="0 0 {size}" mass="1e-13" diaginertia="1e-13 1e-13 1e-13"/>{sphere}'
        )
    chain = "".join(bodies) + "</body>" * count
    w, x, y, z = base["orientation"]
    return (
        f'<mujoco><option gravity="0 0 0" timestep="{STEP_S}" integrator="Euler" cone="elliptic" impratio="10"/>'
        f'<compiler angle="degree"/><size memory="1G"/>'
        f'<default><geom contype="1" conaffinity="2" friction="0.1 0 0" solref="{-0.25 / STEP_S**2} {-1 / STEP_S}" '
        'solimp="0.9999 0.9999 0.01"/></default><worldbody>'
        f'<flexcomp name="wall" type="direct" dim="2" rigid="true" radius="{SHELL_MM}" '
        f'point="{_text(points)}" element="{_text(faces)}"><contact contype="2" conaffinity="1" selfcollide="none" '
        f'friction="0 0 0" solref="{-0.25 / STEP_S**2} {-1 / STEP_S}" solimp="0.9999 0.9999 0.01"/></flexcomp>'
        f'<body pos="{_text(start)}" quat="{w} {x} {y} {z}"><joint type="slide" axis="0 0 1"/>'
        f'<joint type="hinge" axis="0 0 1"/><inertial pos="0 0 0" mass="1e-13" diaginertia="1e-13 1e-13 1e-13"/>'
        f'<geom type="sphere" size="0.01" contype="0" conaffinity="0" mass="0"/>{chain}</body></worldbody></mujoco>'
    )


def _text(values: np.ndarray) -> str:
    return " ".join(f"{value:.5g}" if isinstance(value, float) else str(value) for value in values.ravel().tolist())
