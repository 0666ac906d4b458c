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
_OF_WIRE, _OF_CATHETER = 31, 8
"""Numbers of an observation: of the wire and its route, and of each catheter."""


def space(catheters: int) -> Box:
    """Return the space of one world's observation, of a wire with some catheters; what lies beyond is cut off."""
    return Box(-_BOUND, _BOUND, (_OF_WIRE + _OF_CATHETER * catheters,), np.float32)


@dataclass(frozen=True, eq=False)
class Measured:
    """The worlds at one moment; row i belongs to world i.

    Attributes:
        tip: projections of the devices' tips to the centerline.
        position: of the tips, LPS mm.
        direction: unit vectors along the devices at their tips.
        contact_force: largest force of the wall on one node, N.
        inserted_length: Δ of the devices, mm.
        rotation: φ, rad.
        encoders: both as they are measured: by a robot's encoders where there is a robot.
        valid: false for a world that has failed.
    """

    tip: TipProjection
    position: Float[np.ndarray, "worlds devices 3"]
    direction: Float[np.ndarray, "worlds devices 3"]
    contact_force: Float[np.ndarray, "worlds"]
    inserted_length: Float[np.ndarray, "worlds devices"]
    rotation: Float[np.ndarray, "worlds devices"]
    encoders: Float[np.ndarray, "worlds devices 2"]
    valid: Bool[np.ndarray, "worlds"]

    @classmethod
    def after(
        cls, step: Step, simulator: Simulator, encoders: Float[np.ndarray, "worlds devices 2"] | None
    ) -> Measured:
        """Return the worlds at the end of a step, with what encoders say; what is true if not given."""
        return cls(
            tip=simulator.project(),
            position=step.tip_position,
            direction=step.tip_direction,
            contact_force=step.contact_force_max,
            inserted_length=step.inserted_length,
            rotation=step.rotation,
            encoders=simulator.proximal if encoders is None else encoders,
            valid=step.valid,
        )

    @classmethod
    def current(cls, simulator: Simulator, encoders: Float[np.ndarray, "worlds devices 2"] | None) -> Measured:
        """Return the worlds as they are now, with what encoders say; what is true if not given."""
        return cls(
            tip=simulator.project(),
            position=simulator.tip_position,
            direction=simulator.tip_direction,
            contact_force=simulator.contacts.max(axis=1),
            inserted_length=simulator.inserted_length,
            rotation=simulator.rotation,
            encoders=simulator.proximal if encoders is None else encoders,
            valid=simulator.valid,
        )


def observe(
    now: Measured,
    routes: RouteTables,
    distances_mm: Float[np.ndarray, "worlds devices"],
    force_limit_n: Float[np.ndarray, "worlds"],
    time_share: Float[np.ndarray, "worlds"],
) -> Float[np.ndarray, "worlds features"]:
    """Return the observations, as the tables at `NavigateVectorEnv` have them.

    Args:
        now: the worlds.
        routes: the paths to their targets.
        distances_mm: path length to the target of the devices' tips.
        force_limit_n: their force limits.
        time_share: share of the time limit that is used up.
    """
    tip, inserted, turned = now.tip[:, 0], now.encoders[:, 0, 0], now.encoders[:, 0, 1]
    place = routes.place(tip)
    outside = np.empty((len(time_share), 3, 2))
    outside[:, :, 0] = now.direction[:, 0]
    outside[:, :, 1] = (now.position[:, 0] - place.point) / place.radius[:, None]
    inside = place.frame @ outside
    out = np.empty((len(time_share), _OF_WIRE + _OF_CATHETER * (now.rotation.shape[1] - 1)))
    out[:, 0] = inserted / 100.0
    out[:, 1], out[:, 2] = np.cos(turned), np.sin(turned)
    out[:, 3] = tip.abscissa / 100.0
    out[:, 4] = tip.offset / tip.radius
    out[:, 5] = distances_mm[:, 0] / 100.0
    out[:, 6] = place.on_route
    out[:, 7] = now.contact_force / force_limit_n
    out[:, 8] = time_share
    out[:, 9:12] = inside[:, :, 0]
    out[:, 12:14] = inside[:, 1:, 1]
    out[:, 14:26] = place.ahead
    out[:, 26:30] = place.radius_ahead / 2.0
    out[:, 30] = (inserted - tip.abscissa) / 10.0
    on_route = routes.on_route(now.tip)
    for device in range(1, now.rotation.shape[1]):
        begin = _OF_WIRE + _OF_CATHETER * (device - 1)
        tip, (inserted, turned) = now.tip[:, device], now.encoders[:, device].T
        out[:, begin] = inserted / 100.0
        out[:, begin + 1], out[:, begin + 2] = np.cos(turned), np.sin(turned)
        out[:, begin + 3] = tip.abscissa / 100.0
        out[:, begin + 4] = tip.offset / tip.radius
        out[:, begin + 5] = distances_mm[:, device] / 100.0
        out[:, begin + 6] = on_route[:, device]
        out[:, begin + 7] = (inserted - tip.abscissa) / 10.0
    return np.minimum(np.maximum(out, -_BOUND, out=out), _BOUND, out=out).astype(np.float32)
