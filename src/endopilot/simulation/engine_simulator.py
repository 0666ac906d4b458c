"""Simulators by the name of what moves their wires: the rod core, or a Kirchhoff rod that shares no law with it."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from types import MappingProxyType

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation, Slerp

from endopilot.anatomy.distance import sample
from endopilot.errors import InputError
from endopilot.simulation import core_state as at
from endopilot.simulation.config import FREE_BEHIND_MM
from endopilot.simulation.controls import free_wire_load
from endopilot.simulation.core import insertion_arguments
from endopilot.simulation.groups import Group, prepared
from endopilot.simulation.kirchhoff_rod import NODE_MM, KirchhoffRod, PointWall
from endopilot.simulation.simulator import Simulator, Stepping
from endopilot.simulation.trajectory import SimulatorState, Step

_RESULTANT_MM = 2.0  # length of wire whose forces of the wall are added up, mm, as the core does
_NOT_FINITE, _THROUGH_WALL = 1, 3  # reasons of an invalid world
_READ = ("inserted_length", "rotation", "base_force", "base_torque", "drive_force", "drive_torque")  # from the core's


class EngineSimulator(Simulator):
    """Worlds of one wire each in vessels that lie still, moved as Kirchhoff rods; all else is read as of any simulator.
    Raises InputError where there are catheters, the wall yields or moves, friction differs along the vessel or forces
    are commanded."""

    def set_state(self, state: SimulatorState) -> None:
        """Raise InputError: only the core's state can be restored."""
        raise InputError("state: another engine's state is not restored; drive it again from its start")

    def copy_worlds(self, source: ArrayLike, *, of: Simulator | None = None) -> None:
        """Raise InputError: only the core's worlds can be copied."""
        raise InputError("source: another engine's worlds are not copied; drive each from its start")

    def _run(
        self, group: Group, control: Float[np.ndarray, "members samples devices 2"], how: Stepping
    ) -> dict[str, np.ndarray]:
        if not control.shape[1]:
            begun = super()._run(group, control, how)
            self._begin(group)
            return begun
        if how.worlds is not None:
            raise InputError("worlds: some are given; the engine 'kirchhoff' drives all, leave them out")
        rows = []
        for velocity in control[:, :, 0].swapaxes(0, 1):
            rows.append(self._driven(group, velocity, how.time_step * how.steps))
            if how.advance is not None:
                how.advance(len(velocity))
        names = [*Step.__dataclass_fields__, *(("shape",) if how.record_shape else ())]
        return {name: np.stack([row[name] for row in rows], axis=1) for name in names}

    @cached_property
    def _rods(self) -> dict[int, KirchhoffRod]:
        """The wire of each world."""
        return {}

    def _begin(self, group: Group) -> None:
        """Bring the wires of worlds that were put to the ostium to their first inserted length, as the core does."""
        stack, config = group.stack, self.config
        yields = config.compliant_wall_n_mm2 is not None or self._set_up.motion is not None
        if stack.catheters or yields or config.friction_along or self._set_up.actuation != "velocity":
            raise InputError(
                "engine: kirchhoff; it has a wire alone, driven by velocities, in a rigid vessel of one friction that "
                "lies still; leave the others out"
            )
        values = group.simulation.state()
        for row, world in enumerate(group.index.tolist()):
            if values[row, at.TIME] > 0:
                continue
            if world not in self._rods:
                base = insertion_arguments(group.anatomy.insertion)
                axes = Rotation.from_quat(base["orientation"], scalar_first=True).as_matrix()
                wall = prepared(group.anatomy, lambda: PointWall(group.anatomy.distance_map), "points").wall
                self._rods[world] = KirchhoffRod(wall, base["origin"], axes, stack.wire, group.longest_mm)
            rod, (length, rotation) = self._rods[world], values[row, [at.LENGTH, at.ROTATION]].tolist()
            rod.reset(rotation, friction=float(values[row, at.FRICTION]))
            if length > 0:
                rod.drive((config.approach_velocity_mm_s, 0.0), length / config.approach_velocity_mm_s)
                rod.drive((0.0, 0.0), 0.5)
        self._write(group, np.zeros((len(values), 2)), 0.0)

    def _driven(self, group: Group, velocity: Float[np.ndarray, "members 2"], seconds: float) -> dict[str, np.ndarray]:
        simulation, slipped = group.simulation, np.zeros((2, len(velocity), 1))
        for row, world in enumerate(group.index.tolist()):
            if simulation.reason()[row]:
                continue
            rod, asked = self._rods[world], velocity[row] * seconds
            before = np.array([rod.inserted_mm, rod.rotation_rad])
            velocity[row, 0] = max(velocity[row, 0], -rod.inserted_mm / seconds)
            rod.drive(velocity[row].tolist(), seconds)
            slipped[:, row, 0] = before + asked - [rod.inserted_mm, rod.rotation_rad]
        self._write(group, velocity, seconds)
        pressed = np.stack([self._rods[world].pressed for world in group.index.tolist()])
        window = np.ones(1 + 2 * int(_RESULTANT_MM / 2 / NODE_MM))
        nothing = np.zeros(len(velocity))
        return {
            "contact_force_max": pressed.max(axis=1),
            "contact_force_sum": pressed.sum(axis=1),
            "wall_force": np.array([np.convolve(row, window).max() for row in pressed]),
            "valid": simulation.reason() == 0,
            "tip_position": simulation.tips(),
            "tip_direction": simulation.tip_directions(),
            "shape": simulation.positions(),
            **{name: getattr(simulation, name)() for name in _READ},
            "tip_twist": nothing[:, None],
            "slip": slipped[0],
            "rotation_slip": slipped[1],
            "iterations": nothing,
            "node_iterations": nothing,
        }

    def _write(self, group: Group, velocity: Float[np.ndarray, "members 2"], seconds: float) -> None:
        """Put wires' poses and loads into the core's state, from which everything is read."""
        values, abscissa = group.simulation.state(), group.rod.abscissa_mm
        numbers = at.nodes_of(values, len(abscissa), 1)
        middles = np.append(0.5 * (abscissa[1:] + abscissa[:-1]), np.inf)
        valve = free_wire_load(
            velocity,
            radius_mm=group.stack.wire.tip_radius_mm,
            friction_n=self.config.introducer_friction_n,
            drag_n_s_mm=self.config.introducer_drag_n_s_mm,
            stick_mm_s=self.config.stick_velocity_mm_s,
        )
        for row, world in enumerate(group.index.tolist()):
            if values[row, at.REASON]:
                continue
            rod = self._rods[world]
            if not np.isfinite(rod.position).all():
                values[row, at.REASON] = _NOT_FINITE
                continue
            numbers[row] = 0.0
            # nodes ahead of the catheter, as the core counts them: those whose element's middle is
            ahead = rod.inserted_mm - middles + FREE_BEHIND_MM > 0
            active = int(np.clip(np.argmin(ahead), 1, len(middles) - 2))
            of_rod = rod.abscissa_mm[::-1]
            places = [np.interp(abscissa[:active], of_rod, axis) for axis in rod.position[::-1].T]
            turns = Slerp(of_rod[:-1] + NODE_MM / 2, Rotation.from_matrix(rod.frames[::-1]))
            within = np.clip(middles[:active], NODE_MM / 2, of_rod[-1] - NODE_MM / 2)
            numbers[row, :active, at.POSITION] = np.stack(places, axis=1)
            numbers[row, :active, at.ATTITUDE] = turns(within).as_quat(scalar_first=True)
            nearest = np.clip(np.searchsorted(middles, of_rod), 0, active - 1)
            np.add.at(numbers[row, :, at.CONTACTS[0] + at.NORMAL_FORCE], nearest, rod.pressed[::-1])
            values[row, [at.INSERTED, at.LENGTH]], values[row, at.ACTIVE] = rod.inserted_mm, active
            values[row, at.ROTATION] = values[row, at.DRIVE_ROTATIONS] = rod.rotation_rad
            values[row, at.LOADS] = [*rod.load, *(np.array(rod.load) + valve[row])]
            values[row, at.TIME] += seconds
            inside = rod.position[rod.abscissa_mm < rod.inserted_mm + FREE_BEHIND_MM]
            if sample(group.anatomy.distance_map, inside).min() < -self.config.wall_reach_mm:
                values[row, at.REASON] = _THROUGH_WALL
        group.simulation.set_state(at.with_nodes(values, numbers, 1))


ENGINES: Mapping[str, type[Simulator]] = MappingProxyType({"rod": Simulator, "kirchhoff": EngineSimulator})
"""The simulator of each `World.engine`."""
