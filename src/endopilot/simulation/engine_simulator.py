"""A simulator whose one wire another engine moves, MuJoCo: rigid links with sprung joints, and contacts of its own. It
shares with the rod core the stiffnesses, the lumen's surface and the friction. Joints get an inertia and a damping by
which all come to rest in some hundredths of a second: a wire moves as slowly as without."""

from __future__ import annotations

import importlib
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from endopilot.anatomy.distance import sample
from endopilot.devices.stack import Stack
from endopilot.errors import InputError
from endopilot.extras import extra_named
from endopilot.progress import Advance
from endopilot.simulation import core_state as at
from endopilot.simulation.config import FREE_BEHIND_MM, SimulatorConfig
from endopilot.simulation.controls import free_wire_load
from endopilot.simulation.core import insertion_arguments
from endopilot.simulation.groups import Group
from endopilot.simulation.rod import RodLayout
from endopilot.simulation.simulator import Simulator
from endopilot.simulation.state import SimulatorState, Step
from endopilot.types import Anatomy, DistanceMap, Insertion

STEP_S = 0.002  # time step of MuJoCo, s
SETTLE_S = 0.06
"""Time in which the joints come to rest, s. Velocities are taken away after each step, so that an inertia of stiffness
times this and the step damps a joint, in the equations that contacts solve too, and nothing swings."""
SHELL_MM = 0.4  # the wall's triangles lie so far outside the lumen, mm; a thinner one lets nodes through
MESH_MM = 0.4  # spacing of the grid that the wall's triangles are found on, mm
BEHIND_MM = 3.0  # joints farther behind the ostium are held straight, mm; no wall is needed there
LEAP_MM = 0.1  # a node that would move farther in a step is damped more, as where the wire snaps over, mm
_SLOWEST = 256
_HELD = 1e3  # inertia of a joint that is held, N·mm·s²
_BASE_INERTIA = 1e6  # of the base, which follows the drive, N·s²/mm and N·mm·s²


class EngineWire:
    """One wire in MuJoCo, from a base that follows a drive: inserted length ahead of the ostium, and rotation."""

    def __init__(self, anatomy: Anatomy, rod: RodLayout) -> None:
        """Lay the wire out straight on the catheter's axis, tip at the ostium; ModuleNotFoundError without MuJoCo."""
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
    """Return the surface `SHELL_MM` outside a lumen, LPS mm, without the guiding catheter behind the ostium; no
    triangle stays within `clear_mm` of the catheter's axis."""
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


_RESULTANT_MM = 2.0  # length of wire whose forces of the wall are added up, mm, as the core does
_THROUGH_WALL = 3  # reason of a world whose wire has left the vessel


class EngineSimulator(Simulator):
    """One wire in one vessel that lies still, moved by MuJoCo; all else is read as of any simulator. The drive makes
    every motion that it is asked for, whatever force it takes."""

    def __init__(self, anatomy: Anatomy, device: Stack, *, config: SimulatorConfig) -> None:
        """Lay the wire out by the rod core's elements and introducer. Raises InputError where there are catheters, the
        wall yields, or friction differs along the vessel; ModuleNotFoundError without MuJoCo."""
        if device.catheters or config.compliant_wall_n_mm2 is not None or config.friction_along:
            raise InputError(
                "engine: mujoco; it has a wire alone in a rigid wall of one friction; leave the others out"
            )
        self._wire: EngineWire | None = None
        super().__init__(anatomy, device, config=config)

    def set_state(self, state: SimulatorState) -> None:
        """Raise InputError: only the core's state can be restored."""
        raise InputError("state: another engine's state is not restored; drive it again from its start")

    def _run(
        self,
        group: Group,
        control: Float[np.ndarray, "members samples devices 2"],
        time_step: float,
        steps: int,
        *,
        shape: bool = False,
        advance: Advance | None = None,
    ) -> dict[str, np.ndarray]:
        if not control.shape[1]:
            begun = super()._run(group, control, time_step, steps, shape=shape, advance=advance)
            self._begin(group)
            return begun
        rows = []
        for velocity in control[0, :, 0]:
            rows.append(self._driven(group, (float(velocity[0]), float(velocity[1])), time_step * steps))
            if advance is not None:
                advance(1)
        result = {name: np.stack([row[name] for row in rows])[None] for name in Step.__dataclass_fields__}
        return result | ({"shape": np.stack([row["shape"] for row in rows])[None]} if shape else {})

    def _begin(self, group: Group) -> None:
        values = group.simulation.state()
        length, rotation, friction = (float(values[0, k]) for k in (at.LENGTH, at.ROTATION, at.FRICTION))
        if length <= 0:
            return
        if self._wire is None:
            self._wire = EngineWire(group.anatomy, group.rod)
        self._wire.reset(rotation, friction=friction)
        speed = self.config.approach_velocity_mm_s
        self._wire.drive((speed, 0.0), length / speed)
        self._wire.drive((0.0, 0.0), 0.5)
        self._write(group, self._wire, (0.0, 0.0), 0.0)

    def _driven(self, group: Group, velocity: tuple[float, float], seconds: float) -> dict[str, np.ndarray]:
        wire = self._wire
        assert wire is not None  # a wire that was not begun is at the ostium, where nothing is driven from
        if self.valid[0]:
            ahead = max(velocity[0], -wire.inserted_mm / seconds)
            wire.drive((ahead, velocity[1]), seconds)
            self._write(group, wire, (ahead, velocity[1]), seconds)
        pressed, abscissa = wire.pressed, group.rod.abscissa_mm[:-1]
        near = np.abs(abscissa[:, None] - abscissa) <= _RESULTANT_MM / 2
        found = {
            "contact_force_max": pressed.max(),
            "contact_force_sum": pressed.sum(),
            "wall_force": (near @ pressed).max(),
            "valid": self.valid[0],
            "tip_position": self.tip_position[0],
            "tip_direction": self.tip_direction[0],
            "inserted_length": self.inserted_length[0],
            "rotation": self.rotation[0],
            "shape": group.simulation.positions()[0],
        }
        found |= dict(zip(("base_force", "base_torque"), self.base_load[0].T, strict=True))
        found |= dict(zip(("drive_force", "drive_torque"), self.drive_load[0].T, strict=True))
        nothing = {"tip_twist": 1, "slip": 1, "rotation_slip": 1, "iterations": 0, "node_iterations": 0}
        return {name: np.asarray(value) for name, value in found.items()} | {
            name: np.zeros((1,) * axes) for name, axes in nothing.items()
        }

    def _write(self, group: Group, wire: EngineWire, velocity: tuple[float, float], seconds: float) -> None:
        """Put the wire's pose and loads into the core's state, from which everything is read."""
        values, rod = group.simulation.state(), group.rod
        places, attitudes = wire.nodes
        active = self._active(wire.inserted_mm)
        numbers = np.zeros((1, len(rod.abscissa_mm), at.NODE))
        numbers[0, :active, at.POSITION], numbers[0, :active, at.ATTITUDE] = places[:active], attitudes[:active]
        numbers[0, :active, at.CONTACTS[0] + at.NORMAL_FORCE] = wire.pressed[:active]
        values = at.with_nodes(values, numbers, 1)
        values[0, [at.INSERTED, at.LENGTH]], values[0, at.ACTIVE] = wire.inserted_mm, active
        values[0, at.ROTATION] = values[0, at.DRIVE_ROTATIONS] = wire.rotation_rad
        valve = free_wire_load(
            np.array(velocity),
            radius_mm=group.stack.wire.tip_radius_mm,
            friction_n=self.config.introducer_friction_n,
            drag_n_s_mm=self.config.introducer_drag_n_s_mm,
            stick_mm_s=self.config.stick_velocity_mm_s,
        )
        values[0, at.LOADS] = [*wire.load, *(np.array(wire.load) + valve)]
        values[0, at.TIME] += seconds
        outside = sample(group.anatomy.distance_map, places[: max(active - 1, 1)]).min()
        if outside < -self.config.wall_reach_mm:
            values[0, at.REASON] = _THROUGH_WALL
        group.simulation.set_state(values)

    def _active(self, inserted_mm: float) -> int:
        """Return how many nodes the core would solve for: those whose element's middle is ahead of the catheter."""
        ahead = inserted_mm - self._middles + FREE_BEHIND_MM > 0
        return int(np.clip(np.argmin(ahead), 1, len(self._middles) - 2))

    @cached_property
    def _middles(self) -> Float[np.ndarray, "nodes"]:
        abscissa = self._groups[0].rod.abscissa_mm
        return np.append(0.5 * (abscissa[1:] + abscissa[:-1]), np.inf)
