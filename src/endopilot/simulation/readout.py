"""What can be read of a simulator's worlds at any time: `Readout`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int

from endopilot.simulation.groups import Group
from endopilot.simulation.trajectory import SimulationSetUp
from endopilot.types import TipProjection


class Readout:
    """Devices, loads and tips of worlds as they are now; `Simulator` moves them.

    Arrays have a row a world, in the order in which the worlds were given; where they have an axis of devices, the wire
    comes first, then the catheters around it from the inside out.

    Example:
        >>> simulator.reset(seed=0)
        >>> simulator.worlds, simulator.devices, simulator.nodes == simulator.position.shape[1]
        (4, 1, True)
        >>> of_devices = simulator.inserted_length, simulator.rotation, simulator.drive_rotation
        >>> pairs = simulator.proximal, simulator.at_drive, simulator.base_load, simulator.drive_load, simulator.slip
        >>> tips = simulator.tip_position, simulator.tip_direction
        >>> [each[0].shape[-1] for each in (of_devices, pairs, tips)]
        [1, 2, 3]
        >>> simulator.contacts.shape == simulator.orientation.shape[:2] and bool(simulator.active_nodes.max() > 0)
        True
        >>> simulator.time, simulator.valid, simulator.reason  # s; which are valid; why they are not
        (array([0., 0., 0., 0.]), array([ True,  True,  True,  True]), array([0, 0, 0, 0]))
        >>> bool((simulator.vessel_to_laboratory[:, :, :3] == np.eye(3)).all())  # a vessel that lies still
        True
        >>> tip = simulator.project()
        >>> bool((tip.offset < tip.radius).all())
        True
    """

    _groups: Sequence[Group]
    _set_up: SimulationSetUp
    _devices: int
    _rows: Int[np.ndarray, "worlds"]

    @property
    def worlds(self) -> int:
        """Number of worlds."""
        return len(self._rows)

    @property
    def devices(self) -> int:
        """Number of devices of a world: the wire, and the catheters around it."""
        return self._devices

    @property
    def nodes(self) -> int:
        """Nodes of the longest wire; arrays with a row a node are padded to this."""
        return max(group.simulation.nodes for group in self._groups)

    def project(self) -> TipProjection:
        """Project tips to the centerline: Δtip, γtip and lumen radius, mm, and branch of each world and device."""
        return self._projected([group.simulation.tips() for group in self._groups])

    @property
    def inserted_length(self) -> Float[np.ndarray, "worlds devices"]:
        """Inserted lengths Δ, mm."""
        return self._gather("inserted_length")

    @property
    def rotation(self) -> Float[np.ndarray, "worlds devices"]:
        """Rotations φ of the devices at the ostium, rad."""
        return self._gather("rotation")

    @property
    def drive_rotation(self) -> Float[np.ndarray, "worlds devices"]:
        """Rotations of the drives, rad: ahead of `rotation` by the twist of what lies between drive and ostium."""
        return self._gather("drive_rotation")

    @property
    def at_drive(self) -> Float[np.ndarray, "worlds devices 2"]:
        """Inserted lengths Δ (mm) and rotations (rad) as the drives make them, see `drive_rotation`."""
        return np.stack([self.inserted_length, self.drive_rotation], axis=-1)

    @property
    def proximal(self) -> Float[np.ndarray, "worlds devices 2"]:
        """Inserted lengths Δ (mm) and rotations φ (rad)."""
        return np.stack([self.inserted_length, self.rotation], axis=-1)

    @property
    def base_load(self) -> Float[np.ndarray, "worlds devices 2"]:
        """Axial force (N, positive when it pushes) and torque (N·mm) that hold each device where it enters."""
        return np.stack([self._gather("base_force"), self._gather("base_torque")], axis=-1)

    @property
    def drive_load(self) -> Float[np.ndarray, "worlds devices 2"]:
        """Force (N) and torque (N·mm) of the drives: `base_load` and what the valve takes; controls that move alike."""
        return np.stack([self._gather("drive_force"), self._gather("drive_torque")], axis=-1)

    @property
    def slip(self) -> Float[np.ndarray, "worlds devices 2"]:
        """Advance (mm) and rotation (rad) that the drives were asked for in the last step and did not make."""
        return np.stack([self._gather("slip"), self._gather("rotation_slip")], axis=-1)

    @property
    def tip_position(self) -> Float[np.ndarray, "worlds devices 3"]:
        """Where tips are, LPS mm."""
        return self._gather("tips")

    @property
    def tip_direction(self) -> Float[np.ndarray, "worlds devices 3"]:
        """Unit vectors along the devices at their tips."""
        return self._gather("tip_directions")

    @property
    def position(self) -> Float[np.ndarray, "worlds nodes 3"]:
        """Positions of the nodes from the foremost tip to the base, LPS mm; NaN beyond the nodes of a shorter wire."""
        return self._per_node("positions", np.nan)

    @property
    def orientation(self) -> Float[np.ndarray, "worlds nodes 4"]:
        """Orientations of the elements as quaternions w x y z; the third director points along the wire to its tip."""
        return self._per_node("attitudes", np.nan)

    @property
    def contacts(self) -> Float[np.ndarray, "worlds nodes"]:
        """Force of the wall at each node and at the middle of the element behind it, added up, N."""
        return self._per_node("contacts", 0.0)

    @property
    def active_nodes(self) -> Float[np.ndarray, "worlds"]:
        """Number of nodes ahead of the catheter, those that are solved for."""
        return self._gather("active")

    @property
    def time(self) -> Float[np.ndarray, "worlds"]:
        """Time since each world was put to its first inserted length, s; it is what the vessel moves with."""
        return self._gather("time")

    @property
    def vessel_to_laboratory(self) -> Float[np.ndarray, "worlds 3 4"]:
        """Where each vessel lies now: affine maps of its points, as CT shows them, to the laboratory, LPS mm."""
        return self._placements(self.time[:, None])[:, 0]

    @property
    def valid(self) -> Bool[np.ndarray, "worlds"]:
        """False for a world that left the finite numbers or did not converge; it stays as it was until it is reset."""
        return self.reason == 0

    @property
    def reason(self) -> Int[np.ndarray, "worlds"]:
        """Why a world is invalid: 0 valid, 1 not finite, 2 not converged, 3 the wire went through the wall."""
        return self._gather("reason").astype(int)

    def _projected(self, points: Sequence[Float[np.ndarray, "_ *n 3"]]) -> TipProjection:
        """Return where points of each group's worlds, LPS mm, lie with respect to their centerlines."""
        found = [group.vessel.project(each) for group, each in zip(self._groups, points, strict=True)]
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
