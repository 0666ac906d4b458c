"""A three-dimensional path of plastic tubing, drawn at random, and devices that are pushed through its bore."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from benchmarks.anatomy.analytic_lumens import tree_of
from endopilot.devices.catheter import Catheter
from endopilot.devices.device import Wire
from endopilot.devices.stack import Stack
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.simulate import simulate
from endopilot.types import SAMPLE_PERIOD_S, Anatomy, DistanceMap, Insertion

BORE_MM = 1.65
"""Inner diameter of the tubing, mm: 0.065 inch, as published."""
LENGTH_MM = 200.0
"""Length of the path, mm, as published."""
PROTRUDES_MM = 10.0
"""Length by which the wire stands out of the catheter, mm, as published."""
ANGLES_DEG = ((70.0, 110.0), (60.0, 110.0), (70.0, 110.0), (120.0, 190.0), (60.0, 100.0))
"""Least and largest angle of each bend, degrees: the petrous bend, the foramen lacerum, both bends of the siphon and
the turn into the middle cerebral artery. The article says that the path follows the carotid circulation; the angles are
assumed."""
BEND_RADIUS_MM = (5.0, 12.0)
"""Least and largest radius of a bend's axis, mm, assumed: tubing of this bore kinks when it is bent more tightly."""
TURNED_DEG = (30.0, 150.0)
"""By how much the plane of each bend is turned against that of the bend before, to either side, degrees, assumed."""
SPEED_MM_S = 5.0
"""Speed of the push, mm/s, assumed; nothing but the drag of the fluid depends on it."""
_FINE_MM = 0.05
_SPACING_MM = 0.2
_OUTSIDE_MM = -1.0
_BEHIND_MM = 12.0
"""Length of the straight tube behind the entrance, mm: the guide of the machine."""
_LEAST_STRAIGHT_MM = 1.0
_APART_MM = 4.0
"""Least distance between the axes of two parts of the path, mm: tubing does not pass through itself."""
_END_MM = 5.0
"""The push ends this far ahead of the path's end, mm."""


@dataclass(frozen=True, eq=False)
class Tubing:
    """A path of tubing.

    Attributes:
        axis_mm: points on its axis from behind the entrance on, `_FINE_MM` apart, mm; the entrance is the origin.
        turn_rad: sum of its bends' angles, rad.
    """

    axis_mm: Float[np.ndarray, "n 3"]
    turn_rad: float

    def anatomy(self) -> Anatomy:
        """Return it as a vessel with one branch."""
        start = round(_BEHIND_MM / _FINE_MM)
        return Anatomy(
            name="tubing",
            tree=tree_of((self.axis_mm[start :: round(0.5 / _FINE_MM)], BORE_MM / 2, -1)),
            distance_map=_bore(self.axis_mm),
            insertion=Insertion(self.axis_mm[start], np.array([1.0, 0.0, 0.0])),
            catheter_radius_mm=BORE_MM / 2,
        )


def draw_tubing(
    random: np.random.Generator, *, radius_mm: tuple[float, float] = BEND_RADIUS_MM, angle_share: float = 1.0
) -> Tubing:
    """Draw a path of the published length and bore, with bends as `ANGLES_DEG` and `TURNED_DEG` say.

    What the bends leave of the length is shared at random among the straight pieces between them.

    Args:
        random: the stream.
        radius_mm: least and largest radius of a bend's axis, mm.
        angle_share: share of the angles by which the path bends.
    """
    while True:
        angles = angle_share * np.deg2rad([random.uniform(*limits) for limits in ANGLES_DEG])
        radii = random.uniform(*radius_mm, len(angles))
        turned = np.deg2rad(random.uniform(*TURNED_DEG, len(angles))) * random.choice([-1.0, 1.0], len(angles))
        straight = LENGTH_MM - float(angles @ radii) - (len(angles) + 1) * _LEAST_STRAIGHT_MM
        if straight < 0:
            continue
        pieces = _LEAST_STRAIGHT_MM + straight * random.dirichlet(np.ones(len(angles) + 1))
        axis = _axis(pieces, angles, radii, turned)
        if _clear_of_itself(axis):
            return Tubing(axis, float(angles.sum()))


def _axis(
    pieces: Float[np.ndarray, "bends_and_one"],
    angles: Float[np.ndarray, "bends"],
    radii: Float[np.ndarray, "bends"],
    turned: Float[np.ndarray, "bends"],
) -> Float[np.ndarray, "n 3"]:
    """Return points on straight pieces and bends in turn; `turned` is that of each bend's plane, rad."""
    along, aside = np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])
    tangents = [np.tile(along, (round((_BEHIND_MM + pieces[0]) / _FINE_MM), 1))]
    for piece, angle, radius, turn in zip(pieces[1:], angles, radii, turned, strict=True):
        aside = np.cos(turn) * aside + np.sin(turn) * np.cross(along, aside)
        count = round(radius * angle / _FINE_MM)
        at = angle * (np.arange(count) + 0.5)[:, None] / count
        tangents.append(np.cos(at) * along + np.sin(at) * aside)
        along, aside = np.cos(angle) * along + np.sin(angle) * aside, np.cos(angle) * aside - np.sin(angle) * along
        tangents.append(np.tile(along, (round(piece / _FINE_MM), 1)))
    points = np.concatenate([np.zeros((1, 3)), _FINE_MM * np.cumsum(np.concatenate(tangents), axis=0)])
    return points - [_BEHIND_MM, 0.0, 0.0]


def _clear_of_itself(axis: Float[np.ndarray, "n 3"]) -> bool:
    points = axis[:: round(1 / _FINE_MM)]
    apart = np.linalg.norm(points[:, None] - points[None], axis=-1)
    along = np.abs(np.subtract.outer(np.arange(len(points)), np.arange(len(points))))
    return bool((apart[along > 2.5 * _APART_MM] > _APART_MM).all())


def _bore(axis: Float[np.ndarray, "n 3"]) -> DistanceMap:
    """Return the distance map of the bore around an axis, with round ends."""
    margin = BORE_MM / 2 - _OUTSIDE_MM + 2 * _SPACING_MM
    origin = axis.min(axis=0) - margin
    shape = np.ceil((axis.max(axis=0) + margin - origin) / _SPACING_MM).astype(int) + 1
    values = np.full(shape[::-1], _OUTSIDE_MM)
    reach = int(np.ceil((BORE_MM / 2 - _OUTSIDE_MM) / _SPACING_MM))
    offsets = np.arange(-reach, reach + 1)
    for point in axis:
        near = np.round((point - origin) / _SPACING_MM).astype(int)
        first, last = np.maximum(near - reach, 0), np.minimum(near + reach + 1, shape)
        block = tuple(slice(low, high) for low, high in zip(first[::-1], last[::-1], strict=True))
        x, y, z = (
            (origin[i] + _SPACING_MM * (near[i] + offsets) - point[i])[first[i] - near[i] + reach :][
                : last[i] - first[i]
            ]
            ** 2
            for i in range(3)
        )
        away = np.sqrt(z[:, None, None] + y[None, :, None] + x[None, None, :])
        np.maximum(values[block], BORE_MM / 2 - away, out=values[block])
    return DistanceMap(values=values, spacing_mm=_SPACING_MM, origin_mm=origin)


@dataclass(frozen=True)
class Push:
    """A push through a path.

    Attributes:
        force_n: largest force of the drives together, N.
        through: whether the devices came to the path's end; not where a drive slipped at its limit.
        valid: whether the simulation converged throughout.
    """

    force_n: float
    through: bool
    valid: bool


def push_through(
    anatomy: Anatomy, wire: Wire, catheters: Sequence[Catheter] = (), *, config: SimulatorConfig | None = None
) -> Push:
    """Push a wire, or a wire and the catheters around it together, from the path's entrance to its end.

    Args:
        anatomy: the path.
        wire: the wire, which stands out of the catheters by `PROTRUDES_MM`.
        catheters: from the inside out.
        config: settings of the rod core.
    """
    stack = Stack(wire, tuple(catheters))
    initial = np.zeros((1, len(stack), 2))
    initial[0, 0, 0], initial[0, 1:, 0] = PROTRUDES_MM + 1.0, 1.0
    samples = int((LENGTH_MM - _END_MM - initial[0, 0, 0]) / (SPEED_MM_S * SAMPLE_PERIOD_S))
    control = np.zeros((1, samples, len(stack), 2))
    control[..., 0] = SPEED_MM_S
    rollout = simulate(anatomy, stack, control, initial=initial, config=config)
    force, slip = rollout.base_force[0].sum(axis=-1), np.abs(rollout.slip[0])
    valid = rollout.valid[0]
    return Push(
        force_n=float(force[valid].max(initial=0.0)),
        through=bool(valid.all() and slip.max() < 1e-6),
        valid=bool(valid.all()),
    )
