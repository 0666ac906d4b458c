"""Where the numbers stand of which a state of the core is made: `World` in src/core/world.hpp."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

SCALARS, DEVICE, NODE = 10, 27, 35
"""Numbers of a world, then of each device, then of each node."""
INSERTED, ACTIVE, REASON, TIME = 0, 5, 6, 9
"""Of a world: inserted length, mm, number of nodes ahead of the catheter, why it is invalid, and time, s."""
LENGTH, ROTATION, FRICTION, LOADS = SCALARS, SCALARS + 1, SCALARS + 5, slice(SCALARS + 7, SCALARS + 11)
"""Of the wire: inserted length, mm, rotation, rad, coefficient of friction, and force and torque at the base, then of
the drive, N and N·mm."""
DRIVE_ROTATIONS = slice(SCALARS + 18, SCALARS + DEVICE)
"""Of the wire: rotations of the drive and between it and the ostium, rad."""
POSITION, ATTITUDE = slice(0, 3), slice(3, 7)
"""Of a node: where it lies, mm, and the quaternion of the element behind it."""
CONTACTS = (13, 24)
"""Of a node: where the numbers of its two contact points begin, at the node and at the middle of the element."""
LIMIT, NORMAL_FORCE, OFFSET = 0, 7, slice(8, 11)
"""Of a contact point: limit of friction in the coming step, N, the wall's force, N, and how far the wire's curve lies
beside the polygon there, mm."""


def nodes_of(values: Float[np.ndarray, "worlds numbers"], nodes: int, devices: int) -> Float[np.ndarray, "worlds n m"]:
    """Return a copy of the numbers of each node in a state."""
    first = SCALARS + devices * DEVICE
    return values[:, first : first + nodes * NODE].reshape(len(values), nodes, NODE)


def with_nodes(
    values: Float[np.ndarray, "worlds numbers"], numbers: Float[np.ndarray, "worlds n m"], devices: int
) -> Float[np.ndarray, "worlds numbers"]:
    """Return a state with other numbers of its nodes."""
    changed, first = values.copy(), SCALARS + devices * DEVICE
    changed[:, first : first + numbers[0].size] = numbers.reshape(len(values), -1)
    return changed
