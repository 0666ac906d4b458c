"""A simulator whose one wire another engine moves: `EngineSimulator`."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from jaxtyping import Float

from endopilot.anatomy.distance import sample
from endopilot.devices.stack import Stack
from endopilot.errors import InputError
from endopilot.progress import Advance
from endopilot.simulation import core_state as at
from endopilot.simulation.config import FREE_BEHIND_MM, SimulatorConfig
from endopilot.simulation.controls import free_wire_load
from endopilot.simulation.groups import Group
from endopilot.simulation.other_engine import EngineWire
from endopilot.simulation.simulator import Simulator
from endopilot.simulation.state import SimulatorState, Step
from endopilot.types import Anatomy

_RESULTANT_MM = 2.0
"""Length of wire whose forces of the wall are added up, mm, as the core does."""
_THROUGH_WALL = 3
"""Reason of a world whose wire has left the vessel."""


class EngineSimulator(Simulator):
    """One wire in one vessel that lies still, moved by MuJoCo; all else is read as of any simulator.

    The drive makes every motion that it is asked for, whatever force it takes.
    """

    def __init__(self, anatomy: Anatomy, device: Stack, *, config: SimulatorConfig) -> None:
        """Lay the wire out.

        Args:
            anatomy: the vessel.
            device: the wire.
            config: settings; of the rod core those of its elements and its introducer count.

        Raises:
            InputError: there are catheters, or the wall yields, or friction differs along the vessel.
            ModuleNotFoundError: MuJoCo is not installed.
        """
        if device.catheters or config.compliant_wall_n_mm2 is not None or config.friction_along:
            raise InputError(
                "engine: mujoco; it has a wire alone in a rigid wall of one friction; leave the others out"
            )
        self._wire: EngineWire | None = None
        super().__init__(anatomy, device, config=config)

    def set_state(self, state: SimulatorState) -> None:
        """Refuse another state: only the core's can be restored.

        Raises:
            InputError: always.
        """
        raise InputError("state: another engine's state is not restored; drive it again from its start")

    def _run(
        self,
        group: Group,
        control: Float[np.ndarray, "members samples devices 2"],
        time_step: float,
        steps: int,
        *,
        by_force: bool,
        shape: bool = False,
        advance: Advance | None = None,
    ) -> dict[str, np.ndarray]:
        if not control.shape[1]:
            begun = super()._run(group, control, time_step, steps, by_force=by_force, shape=shape, advance=advance)
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
        """Push the wire from the ostium to where the core has brought its own."""
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
        """Drive the wire for some time, and return what the core would record at its end."""
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
