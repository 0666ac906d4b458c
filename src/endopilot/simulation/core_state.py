"""Where the numbers of a core's state stand (`World` in src/core/world.hpp), through which friction varies along a
vessel."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float

from endopilot.progress import Advance
from endopilot.simulation.groups import Group, factor_at

SCALARS, DEVICE, NODE = 10, 27, 35  # numbers of a world, then of each device, then of each node
INSERTED, ACTIVE, REASON, TIME = 0, 5, 6, 9  # of a world: length, mm, nodes ahead of the catheter, reason, s
LENGTH, ROTATION, FRICTION, LOADS = SCALARS, SCALARS + 1, SCALARS + 5, slice(SCALARS + 7, SCALARS + 11)
"""Of the wire: inserted length, mm, rotation, rad, coefficient of friction, and force and torque at the base, then of
the drive, N and N·mm."""
DRIVE_ROTATIONS = slice(SCALARS + 18, SCALARS + DEVICE)  # the drive's, and between it and the ostium, rad
POSITION, ATTITUDE = slice(0, 3), slice(3, 7)  # of a node, mm, and the quaternion of the element behind it
CONTACTS = (13, 24)  # where a node's two contact points begin, at the node and at its element's middle
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


_SUMMED = ("iterations", "node_iterations", "slip", "rotation_slip", "approach_slip")
"""What adds up over the steps of a sample; of all else the last step's counts."""


def run_along(
    group: Group,
    control: Float[np.ndarray, "worlds samples devices 2"],
    steps: int,
    factors: Sequence[float],
    run: Callable[..., dict[str, np.ndarray]],
    advance: Advance | None = None,
) -> dict[str, np.ndarray]:
    """Run worlds step by step with the core's `run`, and before each multiply every contact's friction by the factor
    (`factor_at`) where it lies. A step that the core shortens ends with the devices' own friction."""
    samples = []
    for sample in range(control.shape[1]):
        now, results = np.ascontiguousarray(control[:, sample : sample + 1]), []
        for _ in range(steps):
            _scale_friction(group, control.shape[2], factors)
            results.append(run(control=now, steps_per_sample=1, progress=None))
        summed = {name: sum(one[name] for one in results) for name in _SUMMED if name in results[-1]}
        samples.append(results[-1] | summed)
        if advance is not None:
            advance(len(control))
    return {name: np.concatenate([one[name] for one in samples], axis=1) for name in samples[0]}


def _scale_friction(group: Group, devices: int, factors: Sequence[float]) -> None:
    """Multiply the limits of friction in the coming step by the factors where the contact points lie."""
    values, position = group.simulation.state(), group.simulation.positions()
    numbers = nodes_of(values, position.shape[1], devices)
    middle = 0.5 * (position + np.roll(position, -1, axis=1))
    for first, points in zip(CONTACTS, (position, middle), strict=True):
        rubs = numbers[..., first + LIMIT] > 0
        if rubs.any():
            abscissa = group.vessel.project(points[rubs]).abscissa
            numbers[rubs, first + LIMIT] *= factor_at(abscissa, group.anatomy.tree, factors)
    group.simulation.set_state(with_nodes(values, numbers, devices))
