"""What counts in the episodes of many worlds: how far each has come, what a step earns, when an episode ends."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from endopilot.devices.stack import column_prefixes
from endopilot.env.observation import Measured, RouteTables
from endopilot.simulation.state import SimulatorState
from endopilot.tasks.navigation import Navigation, is_safe, reached
from endopilot.types import TipProjection

CONTROL_PERIOD_S = 2 / 15
"""Time between two actions, s: fluoroscopy's usual 7.5 frames a second."""
PROGRESS_REWARD, STEP_REWARD, FORCE_REWARD, SUCCESS_REWARD = 0.1, -0.01, -0.1, 5.0
"""A mm nearer to the target, every step, every step with too large a force, and the target."""
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

    def __init__(self, navigations: Sequence[Navigation]) -> None:
        """Begin with no steps; the navigations are of the same devices."""
        count, self._counted = len(navigations), 1 + navigations[0].arriving
        self.routes = RouteTables.of(navigations)
        targets = [navigation.target for navigation in navigations]
        self._target_branch = np.array([target.branch for target in targets])
        self._target_abscissa = np.array([target.abscissa for target in targets])
        self._near_mm = np.array([target.near_mm or np.inf for target in targets])
        self._most_steps = np.array([navigation.periods(CONTROL_PERIOD_S) for navigation in navigations])
        self.seconds = np.array([navigation.seconds for navigation in navigations])
        self.force_limit_n = np.array([navigation.force_limit_n for navigation in navigations])
        self.steps, self.distance = np.full(count, -1), np.zeros((count, self._counted))
        self.safe, self.ended = np.ones(count, dtype=bool), np.zeros(count, dtype=bool)

    @property
    def time_s(self) -> Float[np.ndarray, "worlds"]:
        """Time since each world's reset, s."""
        return self.steps * CONTROL_PERIOD_S

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
        rewards = PROGRESS_REWARD * nearer + STEP_REWARD + FORCE_REWARD * unsafe + SUCCESS_REWARD * success
        rewards = rewards + EXPOSURE_REWARD * exposed
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
