"""What a learning agent is shown of a world: `observe`, whose table stands at `NavigateVectorEnv`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from gymnasium.spaces import Box
from jaxtyping import Bool, Float

from endopilot.env.route import STEP_MM, Routes
from endopilot.simulation.state import Step
from endopilot.simulation.stepping import Simulator
from endopilot.types import TipProjection

AHEAD_MM = np.array([3.0, 6.0, 12.0, 24.0])
"""Distances ahead at which the route is observed, mm."""
_PLACES_AHEAD = np.rint(AHEAD_MM / STEP_MM).astype(np.int64)
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
    def standing(cls, simulator: Simulator) -> Measured:
        """Return the worlds as they stand."""
        return cls(
            tip=simulator.project(),
            position=simulator.position[:, 0],
            direction=tip_direction(simulator),
            contact_force=simulator.contacts.max(axis=1),
            inserted_length=simulator.inserted_length,
            rotation=simulator.rotation,
            valid=simulator.valid,
        )


def tip_direction(simulator: Simulator) -> Float[np.ndarray, "worlds 3"]:
    """Return the unit vectors along the wires at their tips: the third axes of the last elements."""
    w, x, y, z = simulator.orientation[:, 0].T
    return np.column_stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])


def observe(
    now: Measured,
    routes: Routes,
    distance_mm: Float[np.ndarray, "worlds"],
    force_limit_n: Float[np.ndarray, "worlds"],
    time_share: Float[np.ndarray, "worlds"],
) -> Float[np.ndarray, "worlds features"]:
    """Return the observations, as the table at `NavigateVectorEnv` has them.

    Args:
        now: the worlds.
        routes: the ways to their targets.
        distance_mm: what is left of them.
        force_limit_n: their force limits.
        time_share: share of the time limit that is used up.
    """
    rows, place = np.arange(len(time_share)), routes.place(now.tip)
    point, frame = routes.point[rows, place], routes.frame[rows, place]
    ahead = np.minimum(place[:, None] + _PLACES_AHEAD, routes.radius.shape[1] - 1)
    away = (routes.point[rows[:, None], ahead] - point[:, None]) / AHEAD_MM[:, None]
    beside = np.einsum("wij,wj->wi", frame[:, 1:], now.position - point) / routes.radius[rows, place][:, None]
    out = np.empty((len(rows), *SPACE.shape))
    out[:, 0] = now.inserted_length / 100.0
    out[:, 1], out[:, 2] = np.cos(now.rotation), np.sin(now.rotation)
    out[:, 3] = now.tip.abscissa / 100.0
    out[:, 4] = now.tip.offset / now.tip.radius
    out[:, 5] = distance_mm / 100.0
    out[:, 6] = routes.on_route(now.tip)
    out[:, 7] = now.contact_force / force_limit_n
    out[:, 8] = time_share
    out[:, 9:12] = np.einsum("wij,wj->wi", frame, now.direction)
    out[:, 12:14] = beside
    out[:, 14:26] = np.einsum("wij,wkj->wki", frame, away).reshape(len(rows), -1)
    out[:, 26:30] = routes.radius[rows[:, None], ahead] / 2.0
    out[:, 30] = (now.inserted_length - now.tip.abscissa) / 10.0
    return np.clip(out, -_BOUND, _BOUND, out=out).astype(np.float32)
