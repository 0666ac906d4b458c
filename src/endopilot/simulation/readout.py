"""What can be read of a simulator's worlds at any time: `Readout`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int

from endopilot.devices.stack import Stack
from endopilot.errors import InputError
from endopilot.simulation.groups import Group, merge
from endopilot.types import TipProjection


class Readout:
    """Wires, loads and tips of worlds as they are now; `Simulator` moves them.

    Arrays have a row a world, in the order in which the worlds were given.
    """

    _groups: Sequence[Group]
    _stacks: Sequence[Stack]

    def project(self, device: int = 0) -> TipProjection:
        """Project tips to the centerline: Δtip (mm), γtip (mm), branch and lumen radius (mm), a row a world.

        Args:
            device: whose tips, those of the wires (0) or of a catheter (1, 2), from the inside out.

        Raises:
            InputError: there is no such device.

        Example:
            >>> tip = simulator.project()
            >>> bool((tip.offset < tip.radius).all())
            True
        """
        tips = [group.project(points) for group, points in zip(self._groups, self._tips(device), strict=True)]
        names = TipProjection.__dataclass_fields__
        return TipProjection(**{name: self._merge([getattr(tip, name) for tip in tips]) for name in names})

    def tips(self, device: int = 0) -> Float[np.ndarray, "worlds 3"]:
        """Return where tips are, LPS mm, those of the wires (0) or of a catheter (1, 2), from the inside out.

        Raises:
            InputError: there is no such device.

        Example:
            >>> np.array_equal(simulator.tips(), simulator.position[:, 0])  # wires alone
            True
        """
        return self._merge(self._tips(device))

    @property
    def worlds(self) -> int:
        """Number of worlds.

        Example:
            >>> simulator.worlds
            4
        """
        return len(self._stacks)

    @property
    def nodes(self) -> int:
        """Nodes of the longest wire; arrays with a row a node are padded to this.

        Example:
            >>> simulator.contacts.shape == (4, simulator.nodes)
            True
        """
        return max(group.simulation.nodes for group in self._groups)

    @property
    def inserted_length(self) -> Float[np.ndarray, "worlds"]:
        """Inserted lengths Δ, mm.

        Example:
            >>> simulator.inserted_length.shape
            (4,)
        """
        return self._of_devices("inserted_length")[:, 0]

    @property
    def catheter_inserted_length(self) -> Float[np.ndarray, "worlds catheters"]:
        """Inserted lengths of the catheters, mm.

        Example:
            >>> simulator.catheter_inserted_length.shape  # a wire alone
            (4, 0)
        """
        return self._of_devices("inserted_length")[:, 1:]

    @property
    def catheter_rotation(self) -> Float[np.ndarray, "worlds catheters"]:
        """Rotations of the catheters' drives, rad.

        Example:
            >>> simulator.catheter_rotation.shape
            (4, 0)
        """
        return self._of_devices("rotation")[:, 1:]

    @property
    def catheter_drive_load(self) -> Float[np.ndarray, "worlds catheters 2"]:
        """Force (N) and torque (N·mm) of the catheters' drives.

        Example:
            >>> simulator.catheter_drive_load.shape
            (4, 0, 2)
        """
        return self._pair_of_devices("drive_force", "drive_torque")[:, 1:]

    @property
    def catheter_base_load(self) -> Float[np.ndarray, "worlds catheters 2"]:
        """Axial force (N, positive when it pushes) and torque (N·mm) that hold each catheter where it enters.

        Example:
            >>> simulator.catheter_base_load.shape
            (4, 0, 2)
        """
        return self._pair_of_devices("base_force", "base_torque")[:, 1:]

    @property
    def catheter_slip(self) -> Float[np.ndarray, "worlds catheters 2"]:
        """Advance (mm) and rotation (rad) that the catheters' drives were asked for in the last step and did not make.

        Example:
            >>> simulator.catheter_slip.shape
            (4, 0, 2)
        """
        return self._pair_of_devices("slip", "rotation_slip")[:, 1:]

    @property
    def rotation(self) -> Float[np.ndarray, "worlds"]:
        """Rotations φ of the drive, rad.

        Example:
            >>> simulator.reset(inserted_length=np.full(4, 5.0), rotation=[0.0, 0.5, 1.0, 1.5])
            >>> simulator.rotation
            array([0. , 0.5, 1. , 1.5])
        """
        return self._of_devices("rotation")[:, 0]

    @property
    def time(self) -> Float[np.ndarray, "worlds"]:
        """Time since each world was put to its first inserted length, s; it is what the vessel moves with.

        Example:
            >>> simulator.reset(seed=0)
            >>> _ = simulator.step(np.zeros((4, 2)), duration=0.25)
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
        still = np.eye(3, 4)
        return self._merge(
            [
                np.tile(still, (len(group.index), 1, 1))
                if group.motion is None
                else group.motion.placements(group.simulation.time())[0]
                for group in self._groups
            ]
        )

    @property
    def position(self) -> Float[np.ndarray, "worlds nodes 3"]:
        """Positions of the nodes from the tip to the base, LPS mm; NaN beyond the nodes of a shorter wire.

        With catheters the first node is the foremost tip.

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
    def tip_direction(self) -> Float[np.ndarray, "worlds 3"]:
        """Unit vectors along the wires at their tips.

        Example:
            >>> bool(np.allclose(np.linalg.norm(simulator.tip_direction, axis=-1), 1.0))
            True
        """
        return self._of_devices("tip_directions")[:, 0]

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
    def base_load(self) -> Float[np.ndarray, "worlds 2"]:
        """Axial force (N, positive when it pushes) and torque (N·mm) that hold the wire in the catheter.

        Example:
            >>> force_n, torque_n_mm = simulator.base_load.T
            >>> force_n.shape
            (4,)
        """
        return self._pair_of_devices("base_force", "base_torque")[:, 0]

    @property
    def drive_load(self) -> Float[np.ndarray, "worlds 2"]:
        """Force (N) and torque (N·mm) of the drive: `base_load` and what the introducer's valve takes.

        As controls of a force-driven simulator they make the same motion.

        Example:
            >>> simulator.drive_load.shape
            (4, 2)
        """
        return self._pair_of_devices("drive_force", "drive_torque")[:, 0]

    @property
    def slip(self) -> Float[np.ndarray, "worlds 2"]:
        """Advance (mm) and rotation (rad) that the drive was asked for in the last step and did not make.

        Example:
            >>> simulator.slip.shape
            (4, 2)
        """
        return self._pair_of_devices("slip", "rotation_slip")[:, 0]

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

    def _tips(self, device: int) -> list[Float[np.ndarray, "members 3"]]:
        """Return where tips are, an array a group."""
        count = len(self._stacks[0].devices)
        if not 0 <= device < count:
            raise InputError(f"device: {device}; give 0 for the wire" + (f", to {count - 1}" if count > 1 else ""))
        return [np.ascontiguousarray(group.simulation.tips()[:, device]) for group in self._groups]

    def _of_devices(self, name: str) -> Float[np.ndarray, "worlds devices *numbers"]:
        """Return one of the core's numbers of each device, the wire's first."""
        return self._merge([getattr(group.simulation, name)() for group in self._groups])

    def _pair_of_devices(self, first: str, second: str) -> Float[np.ndarray, "worlds devices 2"]:
        return np.stack([self._of_devices(first), self._of_devices(second)], axis=-1)

    def _merge(self, parts: Sequence[np.ndarray]) -> np.ndarray:
        return merge(self._groups, parts)

    def _gather(self, name: str) -> Float[np.ndarray, "worlds"]:
        return self._merge([getattr(group.simulation, name)() for group in self._groups])

    def _per_node(self, name: str, pad: float) -> np.ndarray:
        parts = [getattr(group.simulation, name)() for group in self._groups]
        out = np.full((self.worlds, self.nodes, *parts[0].shape[2:]), pad)
        for group, part in zip(self._groups, parts, strict=True):
            out[group.index, : part.shape[1]] = part
        return out
