"""What a learning agent observes of a world, and what counts in its episodes (docs/concepts/environments.md)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from gymnasium.spaces import Box, Dict, Space
from jaxtyping import Bool, Float, Int

from endopilot.anatomy.tree import parallel_transport, tangents
from endopilot.devices.stack import column_prefixes
from endopilot.env.exposures import Exposed
from endopilot.lines import places_on
from endopilot.simulation.simulator import Simulator
from endopilot.simulation.trajectory import SimulatorState, Step
from endopilot.tasks.navigation import Navigation, is_safe, reached
from endopilot.tasks.route import Route
from endopilot.types import TipProjection

STEP_MM = 0.5
"""Distance of the tables' places along the route, mm."""
AHEAD_MM = np.array([3.0, 6.0, 12.0, 24.0])
"""Distances ahead at which the route is observed, mm."""


@dataclass(frozen=True, eq=False)
class RouteTables:
    """The route of each world, from the ostium to the end of the target's branch.

    Attributes:
        places: a row every `STEP_MM`: the place, LPS mm; tangent and two normals that are carried along without twist;
            radius; the places `AHEAD_MM` farther on, in that frame and in units of that distance; half the radii there.
        leave: for each branch of the tree, where the path into it leaves the route, mm; infinite for those on it.
    """

    places: Float[np.ndarray, "routes places columns"]
    leave: Float[np.ndarray, "routes branches"]
    route: Int[np.ndarray, "worlds"]
    target: Float[np.ndarray, "worlds"]

    @classmethod
    def of(cls, navigations: Sequence[Navigation]) -> RouteTables:
        """Make the tables, once for worlds that have the same navigation."""
        own = list(dict.fromkeys(navigations))
        made = [_tables(Route.to(navigation.anatomy, navigation.target)) for navigation in own]
        places, branches = max(len(row[0]) for row in made), max(len(row[1]) for row in made)
        return cls(
            places=np.stack([np.pad(row[0], [(0, places - len(row[0])), (0, 0)], mode="edge") for row in made]),
            leave=np.stack([np.pad(row[1], (0, branches - len(row[1])), constant_values=np.inf) for row in made]),
            route=np.array([own.index(navigation) for navigation in navigations]),
            target=np.array([navigation.target.abscissa for navigation in navigations]),
        )

    def distance(self, tip: TipProjection) -> Float[np.ndarray, "worlds devices"]:
        """Return the path length from each tip to its target, mm, back out of a wrong branch first."""
        leave = self.leave[self.route[:, None], tip.branch]
        fork = np.minimum(leave, tip.abscissa)
        return (tip.abscissa - fork) + np.abs(self.target[:, None] - fork)

    def on_route(self, tip: TipProjection) -> Bool[np.ndarray, "worlds devices"]:
        """Return which tips lie in a branch of the route."""
        return np.isinf(self.leave[self.route[:, None], tip.branch])

    def place(
        self,
        tip: TipProjection,
        position: Float[np.ndarray, "worlds 3"],
        direction: Float[np.ndarray, "worlds 3"] | None = None,
    ) -> Float[np.ndarray, "worlds columns"]:
        """Return what is observed at the place of each world's route that is nearest to its wire's tip along the tree.

        The wire's direction in the route's frame leads, if it is given, then the tip's offsets along both normals.
        """
        along = np.rint(np.minimum(self.leave[self.route, tip.branch], tip.abscissa) / STEP_MM).astype(np.int64)
        row = self.places[self.route, np.minimum(np.maximum(along, 0), self.places.shape[1] - 1)]
        frame, away = row[:, 3:12].reshape(-1, 3, 3), (position - row[:, :3]) / row[:, 12:13]
        columns = [(frame[:, 1:] @ away[..., None])[..., 0], row[:, 13:]]
        return np.column_stack(columns if direction is None else [(frame @ direction[..., None])[..., 0], *columns])


def _tables(route: Route) -> tuple[np.ndarray, np.ndarray]:
    line = route.line
    along = np.arange(0.0, line.abscissa[-1], STEP_MM)
    point = places_on(line.points, line.abscissa, along)
    radius = np.interp(along, line.abscissa, line.radius)
    tangent, normal = tangents(point), parallel_transport(point)
    frame = np.stack([tangent, normal, np.cross(tangent, normal)], axis=1)
    index = np.arange(len(along))[:, None] + np.rint(AHEAD_MM / STEP_MM).astype(np.int64)
    index = np.minimum(index, len(along) - 1)
    away = np.einsum("pij,pkj->pki", frame, (point[index] - point[:, None]) / AHEAD_MM[:, None])
    table = [point, frame.reshape(-1, 9), radius, away.reshape(len(along), -1), radius[index] / 2.0]
    return np.column_stack(table), route.leaves_at


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

    `worlds` has where devices lie then, and `contact_force` the largest force on one node, N, over the step that led
    there; `tip` are projections of the tips, `distance_mm` path lengths from them to the target, and `encoders` are Δ,
    mm, and φ, rad, as measured.
    """

    worlds: Simulator | Step
    contact_force: Float[np.ndarray, "worlds"]
    tip: TipProjection
    distance_mm: Float[np.ndarray, "worlds devices"]
    encoders: Float[np.ndarray, "worlds devices 2"]


def observe(
    now: Measured,
    routes: RouteTables,
    force_limit_n: Float[np.ndarray, "worlds"],
    time_share: Float[np.ndarray, "worlds"],
) -> Float[np.ndarray, "worlds features"]:
    """Return the observations, as the specification has them."""
    out, on_route = list[np.ndarray](), routes.on_route(now.tip)
    for device in range(now.encoders.shape[1]):
        tip, (inserted, turned) = now.tip[:, device], now.encoders[:, device].T
        out += [inserted / 100.0, np.cos(turned), np.sin(turned), tip.abscissa / 100.0, tip.offset / tip.radius]
        out += [now.distance_mm[:, device] / 100.0, on_route[:, device]]
        if device == 0:
            out += [now.contact_force / force_limit_n, time_share]
            out += [routes.place(tip, now.worlds.tip_position[:, 0], now.worlds.tip_direction[:, 0])]
        out += [(inserted - tip.abscissa) / 10.0]
    return _bounded(np.column_stack(out))


def observe_exposed(
    proximal: Float[np.ndarray, "worlds devices 4"],
    exposed: Exposed,
    routes: RouteTables | None,
    time_s: Float[np.ndarray, "worlds"],
    time_share: Float[np.ndarray, "worlds"],
) -> Float[np.ndarray, "worlds features"]:
    """Return what is measured, as the specification has it; without routes, where exposures are images."""
    wire, *catheters = (
        [inserted / 100.0, np.cos(turned), np.sin(turned), force / 0.5, torque / 0.5]
        for inserted, turned, force, torque in proximal.transpose(1, 2, 0)
    )
    since = (proximal[:, 0, :2] - exposed.encoders) / [10.0, np.pi]
    out = [*wire, time_share, (time_s - exposed.time_s) / 10.0, since]
    if routes is not None:
        tip = exposed.tip[:, 0]
        out += [tip.abscissa / 100.0, tip.offset / tip.radius, routes.distance(exposed.tip) / 100.0]
        out += [routes.on_route(exposed.tip), routes.place(tip, exposed.position)]
        out += [(exposed.encoders[:, 0] - tip.abscissa) / 10.0]
    return _bounded(np.column_stack([*out, *(column for catheter in catheters for column in catheter)]))


def _bounded(values: Float[np.ndarray, "worlds features"]) -> Float[np.ndarray, "worlds features"]:
    return np.minimum(np.maximum(values, -_BOUND, out=values), _BOUND, out=values).astype(np.float32)


CONTROL_PERIOD_S = 2 / 15
"""Time between two actions if not said, s: fluoroscopy's usual 7.5 frames a second."""
PROGRESS_REWARD, STEP_REWARD, FORCE_REWARD, SUCCESS_REWARD = 0.1, -0.01, -0.1, 5.0
"""A mm nearer to the target, `CONTROL_PERIOD_S` of time, the same with too large a force, and the target."""
EXPOSURE_REWARD = -0.05
"""Every exposure, where X-ray shows the tip."""


@dataclass(frozen=True, eq=False)
class NavigationState:
    """All that the future of a `NavigateVectorEnv` depends on; it can be pickled and copied.

    Attributes:
        simulator: the worlds.
        kept: all else: how far the episodes are, random generators, robots and what else is drawn, the last exposures.
    """

    simulator: SimulatorState
    kept: dict[str, Any]


class Episodes:
    """The episodes that many worlds are in; row i belongs to world i.

    Attributes:
        steps: of each world since its reset; -1 before the first.
        distance: path length from each tip that counts to its target at the last step, mm.
        safe: worlds whose force has not been too large since their reset.
    """

    def __init__(self, navigations: Sequence[Navigation], period_s: float) -> None:
        """Begin with no steps, each `period_s` long; the navigations are of the same devices."""
        self.period_s = period_s
        count, self._counted = len(navigations), 1 + navigations[0].arriving
        self.routes = RouteTables.of(navigations)
        targets = [navigation.target for navigation in navigations]
        self._target_branch = np.array([target.branch for target in targets])
        self._target_abscissa = np.array([target.abscissa for target in targets])
        self._near_mm = np.array([target.near_mm or np.inf for target in targets])
        self._most_steps = np.array([navigation.periods(period_s) for navigation in navigations])
        self.seconds = np.array([navigation.seconds for navigation in navigations])
        self.force_limit_n = np.array([navigation.force_limit_n for navigation in navigations])
        self.steps, self.distance = np.full(count, -1), np.zeros((count, self._counted))
        self.safe, self.ended = np.ones(count, dtype=bool), np.zeros(count, dtype=bool)

    @property
    def time_s(self) -> Float[np.ndarray, "worlds"]:
        """Time since each world's reset, s."""
        return self.steps * self.period_s

    def begin(self, mask: Bool[np.ndarray, "worlds"], tip: TipProjection) -> None:
        """Start an episode in the worlds of a mask."""
        self.steps[mask], self.safe[mask], self.ended[mask] = 0, True, False
        self.distance = np.where(mask[:, None], self.routes.distance(tip)[:, : self._counted], self.distance)

    def judge(
        self,
        now: Measured,
        fresh: Bool[np.ndarray, "worlds"],
        exposed: Bool[np.ndarray, "worlds"],
    ) -> tuple[Float[np.ndarray, "worlds"], Bool[np.ndarray, "worlds"], Bool[np.ndarray, "worlds"]]:
        """Return rewards, terminations and truncations of a step, in which the worlds of `fresh` have only begun."""
        going, before = ~fresh, self.distance
        self.distance = now.distance_mm[:, : self._counted]
        unsafe = ~is_safe(now.contact_force, self.force_limit_n) & going
        self.safe &= ~unsafe
        success = self._success(now) & going
        nearer = (before - self.distance).sum(axis=1)
        of_time = (STEP_REWARD + FORCE_REWARD * unsafe) * (self.period_s / CONTROL_PERIOD_S)
        rewards = PROGRESS_REWARD * nearer + of_time + SUCCESS_REWARD * success + EXPOSURE_REWARD * exposed
        terminations = (success | ~now.worlds.valid) & going
        truncations = (self.steps >= self._most_steps) & ~terminations & going
        self.ended = terminations | truncations
        return np.where(fresh, 0.0, rewards), terminations, truncations

    def _success(self, now: Measured) -> Bool[np.ndarray, "worlds"]:
        return reached(now.tip[:, : self._counted], self._target_branch, self._target_abscissa, self._near_mm)

    def infos(self, now: Measured) -> dict[str, Any]:
        """Return what stands in the info of every world, as `NavigateVectorEnv` names it."""
        infos: dict[str, Any] = {
            "contact_force_max": now.contact_force,
            "valid": now.worlds.valid,
            "success": self._success(now),
            "safe": self.safe.copy(),
            "distance_mm": self.distance[:, -1],
            "time_s": self.time_s,
        }
        for k, prefix in enumerate(column_prefixes(now.encoders.shape[1])):
            tip = now.tip[:, k]
            infos |= {
                f"{prefix}inserted_length": now.worlds.inserted_length[:, k],
                f"{prefix}rotation": now.worlds.rotation[:, k],
                f"{prefix}tip_abscissa": tip.abscissa,
                f"{prefix}tip_offset": tip.offset,
                f"{prefix}tip_branch": tip.branch,
            }
        return infos
