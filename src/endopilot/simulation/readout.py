"""What can be read of a simulator's worlds at any time: `Readout`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int

from endopilot.simulation.groups import Group
from endopilot.simulation.state import SimulationSetUp
from endopilot.types import TipProjection


class Readout:
    """Devices, loads and tips of worlds as they are now; `Simulator` moves them.

    Arrays have a row a world, in the order in which the worlds were given; where they have an axis of devices, the wire
    comes first, then the catheters around it from the inside out.
    """

    _groups: Sequence[Group]
    _set_up: SimulationSetUp
    _devices: int
    _rows: Int[np.ndarray, "worlds"]

    @property
    def worlds(self) -> int:
        """Number of worlds.

        Example:
            >>> simulator.worlds
            4
        """
        return len(self._rows)

    @property
    def devices(self) -> int:
        """Number of devices of a world: the wire, and the catheters around it.

        Example:
            >>> simulator.devices
            1
        """
        return self._devices

    @property
    def nodes(self) -> int:
        """Nodes of the longest wire; arrays with a row a node are padded to this.

        Example:
            >>> simulator.contacts.shape == (4, simulator.nodes)
            True
        """
        return max(group.simulation.nodes for group in self._groups)

    def project(self) -> TipProjection:
        """Project tips to the centerline: Δtip (mm), γtip (mm), branch and lumen radius (mm) of each world and device.

        Example:
            >>> tip = simulator.project()
            >>> bool((tip.offset < tip.radius).all())
            True
        """
        return self._projected([group.simulation.tips() for group in self._groups])

    @property
    def inserted_length(self) -> Float[np.ndarray, "worlds devices"]:
        """Inserted lengths Δ, mm.

        Example:
            >>> simulator.inserted_length.shape
            (4, 1)
        """
        return self._gather("inserted_length")

    @property
    def rotation(self) -> Float[np.ndarray, "worlds devices"]:
        """Rotations φ of the devices at the ostium, rad.

        Example:
            >>> simulator.reset(inserted_length=np.full(4, 5.0), rotation=[0.0, 0.5, 1.0, 1.5])
            >>> simulator.rotation[:, 0]
            array([0. , 0.5, 1. , 1.5])
        """
        return self._gather("rotation")

    @property
    def drive_rotation(self) -> Float[np.ndarray, "worlds devices"]:
        """Rotations of the drives, rad: ahead of `rotation` by the twist of what lies between drive and ostium.

        Example:
            >>> np.array_equal(simulator.drive_rotation, simulator.rotation)  # where drives act at the ostium
            True
        """
        return self._gather("drive_rotation")

    @property
    def at_drive(self) -> Float[np.ndarray, "worlds devices 2"]:
        """Inserted lengths Δ (mm) and rotations (rad) as the drives make them, see `drive_rotation`.

        Example:
            >>> simulator.at_drive.shape
            (4, 1, 2)
        """
        return np.stack([self.inserted_length, self.drive_rotation], axis=-1)

    @property
    def proximal(self) -> Float[np.ndarray, "worlds devices 2"]:
        """Inserted lengths Δ (mm) and rotations φ (rad).

        Example:
            >>> simulator.proximal.shape
            (4, 1, 2)
        """
        return np.stack([self.inserted_length, self.rotation], axis=-1)

    @property
    def base_load(self) -> Float[np.ndarray, "worlds devices 2"]:
        """Axial force (N, positive when it pushes) and torque (N·mm) that hold each device where it enters.

        Example:
            >>> force_n, torque_n_mm = simulator.base_load[:, 0].T
            >>> force_n.shape
            (4,)
        """
        return np.stack([self._gather("base_force"), self._gather("base_torque")], axis=-1)

    @property
    def drive_load(self) -> Float[np.ndarray, "worlds devices 2"]:
        """Force (N) and torque (N·mm) of the drives: `base_load` and what the introducer's valve takes.

        As controls of a force-driven simulator they make the same motion.

        Example:
            >>> simulator.drive_load.shape
            (4, 1, 2)
        """
        return np.stack([self._gather("drive_force"), self._gather("drive_torque")], axis=-1)

    @property
    def slip(self) -> Float[np.ndarray, "worlds devices 2"]:
        """Advance (mm) and rotation (rad) that the drives were asked for in the last step and did not make.

        Example:
            >>> simulator.slip.shape
            (4, 1, 2)
        """
        return np.stack([self._gather("slip"), self._gather("rotation_slip")], axis=-1)

    @property
    def tip_position(self) -> Float[np.ndarray, "worlds devices 3"]:
        """Where tips are, LPS mm.

        Example:
            >>> np.array_equal(simulator.tip_position[:, 0], simulator.position[:, 0])  # wires alone
            True
        """
        return self._gather("tips")

    @property
    def tip_direction(self) -> Float[np.ndarray, "worlds devices 3"]:
        """Unit vectors along the devices at their tips.

        Example:
            >>> bool(np.allclose(np.linalg.norm(simulator.tip_direction, axis=-1), 1.0))
            True
        """
        return self._gather("tip_directions")

    @property
    def position(self) -> Float[np.ndarray, "worlds nodes 3"]:
        """Positions of the nodes from the foremost tip to the base, LPS mm; NaN beyond the nodes of a shorter wire.

        Example:
            >>> simulator.position.shape == (4, simulator.nodes, 3)
            True
        """
        return self._per_node("positions", np.nan)

    @property
    def orientation(self) -> Float[np.ndarray, "worlds nodes 4"]:
        """Orientations of the elements as quaternions w x y z; the third director points along the wire to its tip.

        Example:
            >>> bool(np.allclose(np.linalg.norm(simulator.orientation, axis=-1), 1.0))
            True
        """
        return self._per_node("attitudes", np.nan)

    @property
    def contacts(self) -> Float[np.ndarray, "worlds nodes"]:
        """Force of the wall at each node and at the middle of the element behind it, added up, N.

        Example:
            >>> bool((simulator.contacts >= 0).all())
            True
        """
        return self._per_node("contacts", 0.0)

    @property
    def active_nodes(self) -> Float[np.ndarray, "worlds"]:
        """Number of nodes ahead of the catheter, those that are solved for.

        Example:
            >>> bool((simulator.active_nodes <= simulator.nodes).all())
            True
        """
        return self._gather("active")

    @property
    def time(self) -> Float[np.ndarray, "worlds"]:
        """Time since each world was put to its first inserted length, s; it is what the vessel moves with.

        Example:
            >>> simulator.reset(seed=0)
            >>> _ = simulator.step(np.zeros((4, 2)), duration_s=0.25)
            >>> simulator.time
            array([0.25, 0.25, 0.25, 0.25])
        """
        return self._gather("time")

    @property
    def vessel_to_laboratory(self) -> Float[np.ndarray, "worlds 3 4"]:
        """Where each vessel lies now: affine maps of its points, as CT shows them, to the laboratory, LPS mm.

        Example:
            >>> bool((simulator.vessel_to_laboratory[:, :, :3] == np.eye(3)).all())  # a vessel that lies still
            True
        """
        return self._placements(self.time[:, None])[:, 0]

    @property
    def valid(self) -> Bool[np.ndarray, "worlds"]:
        """False for a world that left the finite numbers or did not converge; it stays as it was until it is reset.

        Example:
            >>> simulator.valid
            array([ True,  True,  True,  True])
        """
        return self.reason == 0

    @property
    def reason(self) -> Int[np.ndarray, "worlds"]:
        """Why a world is invalid: 0 it is valid, 1 it left the finite numbers, 2 it did not converge,
        3 the wire went through the wall.

        Example:
            >>> simulator.reason
            array([0, 0, 0, 0])
        """
        return self._gather("reason").astype(int)

    def _projected(self, points: Sequence[Float[np.ndarray, "_ *n 3"]]) -> TipProjection:
        """Return where points of each group's worlds, LPS mm, lie with respect to their centerlines."""
        found = [group.project(each) for group, each in zip(self._groups, points, strict=True)]
        names = TipProjection.__dataclass_fields__
        return TipProjection(**{name: self._merge([getattr(tip, name) for tip in found]) for name in names})

    def _placements(self, times: Float[np.ndarray, "worlds samples"]) -> Float[np.ndarray, "worlds samples 3 4"]:
        still, parts = np.eye(3, 4), []
        for group, at in self._of_groups(times):
            if group.motion is None:
                parts.append(np.tile(still, (*at.shape, 1, 1)))
            else:
                parts.append(group.motion.placements(np.ascontiguousarray(at.ravel()))[0].reshape(*at.shape, 3, 4))
        return self._merge(parts)

    def _of_groups(self, values: np.ndarray) -> list[tuple[Group, np.ndarray]]:
        return [(group, values[group.index]) for group in self._groups]

    def _merge(self, parts: Sequence[np.ndarray]) -> np.ndarray:
        return parts[0] if len(parts) == 1 else np.concatenate(parts)[self._rows]

    def _gather(self, name: str) -> np.ndarray:
        return self._merge([getattr(group.simulation, name)() for group in self._groups])

    def _per_node(self, name: str, pad: float) -> np.ndarray:
        parts = [getattr(group.simulation, name)() for group in self._groups]
        out = np.full((self.worlds, self.nodes, *parts[0].shape[2:]), pad)
        for group, part in zip(self._groups, parts, strict=True):
            out[group.index, : part.shape[1]] = part
        return out
