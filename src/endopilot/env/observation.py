"""What a learning agent observes of a world: `observe`; the table is in `NavigateVectorEnv`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from gymnasium.spaces import Box
from jaxtyping import Bool, Float

from endopilot.env.route_tables import RouteTables
from endopilot.simulation.simulator import Simulator
from endopilot.simulation.state import Step
from endopilot.types import TipProjection

_BOUND = 10.0
SPACE = Box(-_BOUND, _BOUND, (31,), np.float32)
"""Of one world's observation; what lies beyond is cut off."""


@dataclass(frozen=True, eq=False)
class Measured:
    """The worlds at one moment; row i belongs to world i.

    Attributes:
        tip: the tips' projections to the centerline.
        position: of the tips, LPS mm.
        direction: unit vectors along the wires at their tips.
        contact_force: largest force of the wall on one node, N.
        inserted_length: Δ, mm.
        rotation: φ, rad.
        valid: false for a world that has failed.
    """

    tip: TipProjection
    position: Float[np.ndarray, "worlds 3"]
    direction: Float[np.ndarray, "worlds 3"]
    contact_force: Float[np.ndarray, "worlds"]
    inserted_length: Float[np.ndarray, "worlds"]
    rotation: Float[np.ndarray, "worlds"]
    valid: Bool[np.ndarray, "worlds"]

    @classmethod
    def after(cls, step: Step, simulator: Simulator) -> Measured:
        """Return the worlds at the end of a step."""
        return cls(
            tip=simulator.project(),
            position=step.tip_position,
            direction=step.tip_direction,
            contact_force=step.contact_force_max,
            inserted_length=step.inserted_length,
            rotation=step.rotation,
            valid=step.valid,
        )

    @classmethod
    def current(cls, simulator: Simulator) -> Measured:
        """Return the worlds as they are now."""
        return cls(
            tip=simulator.project(),
            position=simulator.position[:, 0],
            direction=simulator.tip_direction,
            contact_force=simulator.contacts.max(axis=1),
            inserted_length=simulator.inserted_length,
            rotation=simulator.rotation,
            valid=simulator.valid,
        )


def observe(
    now: Measured,
    routes: RouteTables,
    distance_mm: Float[np.ndarray, "worlds"],
    force_limit_n: Float[np.ndarray, "worlds"],
    time_share: Float[np.ndarray, "worlds"],
) -> Float[np.ndarray, "worlds features"]:
    """Return the observations, as the table at `NavigateVectorEnv` has them.

    Args:
        now: the worlds.
        routes: the paths to their targets.
        distance_mm: path length that is left.
        force_limit_n: their force limits.
        time_share: share of the time limit that is used up.
    """
    place, tip = routes.place(now.tip), now.tip
    outside = np.empty((len(time_share), 3, 2))
    outside[:, :, 0] = now.direction
    outside[:, :, 1] = (now.position - place.point) / place.radius[:, None]
    inside = place.frame @ outside
    out = np.empty((len(time_share), *SPACE.shape))
    out[:, 0] = now.inserted_length / 100.0
    out[:, 1], out[:, 2] = np.cos(now.rotation), np.sin(now.rotation)
    out[:, 3] = tip.abscissa / 100.0
    out[:, 4] = tip.offset / tip.radius
    out[:, 5] = distance_mm / 100.0
    out[:, 6] = place.on_route
    out[:, 7] = now.contact_force / force_limit_n
    out[:, 8] = time_share
    out[:, 9:12] = inside[:, :, 0]
    out[:, 12:14] = inside[:, 1:, 1]
    out[:, 14:26] = place.ahead
    out[:, 26:30] = place.radius_ahead / 2.0
    out[:, 30] = (now.inserted_length - tip.abscissa) / 10.0
    return np.minimum(np.maximum(out, -_BOUND, out=out), _BOUND, out=out).astype(np.float32)
