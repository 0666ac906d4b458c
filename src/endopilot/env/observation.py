"""What a learning agent observes of a world: `observe` or `observe_exposed`; the tables are in `NavigateVectorEnv`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from gymnasium.spaces import Box, Dict, Space
from jaxtyping import Bool, Float

from endopilot.env.exposures import Exposed
from endopilot.env.route_tables import RouteTables
from endopilot.simulation.simulator import Simulator
from endopilot.simulation.state import Step
from endopilot.types import TipProjection

_BOUND = 10.0
_OF_WIRE, _OF_CATHETER = 31, 8
"""Numbers of an observation: of the wire and its route, and of each catheter."""
_AT_DRIVES, _OF_TIP, _DRIVE_OF_CATHETER = 9, 23, 5
"""Numbers where X-ray shows the tip: of the wire's drive and the last exposure's age, of the tip, of each catheter."""
Observed = Literal["state", "xray", "image"]
"""What is observed: all as it truly is; or encoders, loads, and the last exposure, as a measured tip or images."""


def space(observed: Observed, catheters: int, images: tuple[int, int, int]) -> Space:
    """Return the space of one world's observation; what lies beyond is cut off."""
    if observed == "state":
        return Box(-_BOUND, _BOUND, (_OF_WIRE + _OF_CATHETER * catheters,), np.float32)
    of_tip = _OF_TIP if observed == "xray" else 0
    measured = Box(-_BOUND, _BOUND, (_AT_DRIVES + of_tip + _DRIVE_OF_CATHETER * catheters,), np.float32)
    return measured if observed == "xray" else Dict({"image": Box(0, 255, images, np.uint8), "measured": measured})


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
    def after(cls, step: Step, simulator: Simulator, encoders: Float[np.ndarray, "worlds devices 2"]) -> Measured:
        """Return the worlds at the end of a step, with what encoders say."""
        return cls(
            tip=simulator.project(),
            position=step.tip_position,
            direction=step.tip_direction,
            contact_force=step.contact_force_max,
            inserted_length=step.inserted_length,
            rotation=step.rotation,
            encoders=encoders,
            valid=step.valid,
        )

    @classmethod
    def current(cls, simulator: Simulator, encoders: Float[np.ndarray, "worlds devices 2"]) -> Measured:
        """Return the worlds as they are now, with what encoders say."""
        return cls(
            tip=simulator.project(),
            position=simulator.tip_position,
            direction=simulator.tip_direction,
            contact_force=simulator.contacts.max(axis=1),
            inserted_length=simulator.inserted_length,
            rotation=simulator.rotation,
            encoders=encoders,
            valid=simulator.valid,
        )


def observe(
    now: Measured,
    routes: RouteTables,
    distances_mm: Float[np.ndarray, "worlds devices"],
    force_limit_n: Float[np.ndarray, "worlds"],
    time_share: Float[np.ndarray, "worlds"],
) -> Float[np.ndarray, "worlds features"]:
    """Return the observations, as the tables at `NavigateVectorEnv` have them."""
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
    return _bounded(out)


def observe_exposed(
    proximal: Float[np.ndarray, "worlds devices 4"],
    exposed: Exposed,
    routes: RouteTables | None,
    time_s: Float[np.ndarray, "worlds"],
    time_share: Float[np.ndarray, "worlds"],
) -> Float[np.ndarray, "worlds features"]:
    """Return what is measured, as the table at `NavigateVectorEnv` has it.

    Args:
        proximal: Δ, mm, φ, rad, and the drives' force and torque, N and N·mm, as they are measured.
        routes: the paths to the targets; not given where exposures are images.
    """
    around = proximal.shape[1] - 1
    of_tip = 0 if routes is None else _OF_TIP
    out = np.empty((len(time_s), _AT_DRIVES + of_tip + _DRIVE_OF_CATHETER * around))
    begins = (0, *(_AT_DRIVES + of_tip + _DRIVE_OF_CATHETER * k for k in range(around)))
    for begin, (inserted, turned, force, torque) in zip(begins, proximal.transpose(1, 2, 0), strict=True):
        out[:, begin] = inserted / 100.0
        out[:, begin + 1], out[:, begin + 2] = np.cos(turned), np.sin(turned)
        out[:, begin + 3], out[:, begin + 4] = force / 0.5, torque / 0.5
    out[:, 5] = time_share
    out[:, 6] = (time_s - exposed.time_s) / 10.0
    since = proximal[:, 0, :2] - exposed.encoders
    out[:, 7], out[:, 8] = since[:, 0] / 10.0, since[:, 1] / np.pi
    if routes is not None:
        tip = exposed.tip[:, 0]
        place, begin = routes.place(tip), _AT_DRIVES
        out[:, begin] = tip.abscissa / 100.0
        out[:, begin + 1] = tip.offset / tip.radius
        out[:, begin + 2] = routes.distance(exposed.tip)[:, 0] / 100.0
        out[:, begin + 3] = place.on_route
        away = (exposed.position - place.point) / place.radius[:, None]
        out[:, begin + 4 : begin + 6] = (place.frame[:, 1:] @ away[..., None])[..., 0]
        out[:, begin + 6 : begin + 18] = place.ahead
        out[:, begin + 18 : begin + 22] = place.radius_ahead / 2.0
        out[:, begin + 22] = (exposed.encoders[:, 0] - tip.abscissa) / 10.0
    return _bounded(out)


def _bounded(values: Float[np.ndarray, "worlds features"]) -> Float[np.ndarray, "worlds features"]:
    return np.minimum(np.maximum(values, -_BOUND, out=values), _BOUND, out=values).astype(np.float32)
