"""Copies of simulated devices that are moved to and fro until one lies as X-ray shows it: `MovedCopies`.

Soft devices lie otherwise after they were pushed and pulled, though their drives are where they were: what lies in
loops comes out elsewhere. So copies whose drives go somewhere and come back lie in many of the ways in which the real
devices may.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float

from endopilot.devices.drive_limits import DriveLimits
from endopilot.devices.stack import Stack
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.motion import Motion
from endopilot.simulation.simulator import Simulator
from endopilot.tasks.navigation import DECISION_PERIOD_S
from endopilot.types import Anatomy

_ROUNDS, _PERIODS = 4, 3
"""Rounds, each from the nearest copy of the last, and decision periods that drives go away in each and come back."""
_NEAR_ENOUGH = 0.5
"""Misfit below which no further round is needed."""
_TURN_RAD_S = np.pi / 2
"""Speed at which copies are turned at most, rad/s."""
_REST_SHARE = 0.4
"""Share of the copies in which a catheter rests."""

Misfit = Callable[[Simulator], Float[np.ndarray, "worlds"]]
"""How far the devices of each world are from what X-ray shows: 1 where it just explains them."""


class MovedCopies:
    """Copies of a belief's likeliest devices.

    Attributes:
        simulator: of the copies.
        at: the one that was found nearest to what X-ray shows.
    """

    def __init__(
        self,
        kind: tuple[Anatomy, Stack],
        count: int,
        *,
        limits: Sequence[DriveLimits],
        motion: Motion | None,
        config: SimulatorConfig,
        sharing: Simulator,
    ) -> None:
        """Prepare the copies."""
        anatomy, stack = kind
        self.simulator = Simulator(anatomy, stack, worlds=count, motion=motion, config=config, sharing=[sharing])
        self._limits = list(limits)
        self._random, self.at = np.random.default_rng(0xC0B1), 0

    def seek(self, member: int, of: Simulator, misfit: Misfit) -> float:
        """Move copies of a member to and fro; return how near the nearest comes, `at`."""
        copies, count = self.simulator, self.simulator.worlds
        copies.copy_worlds(np.full(count, member), of=of)
        best = np.inf
        for number in range(_ROUNDS):
            control = self._draw()
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # one that fails is not chosen
                for direction in (1.0, -1.0):
                    for _ in range(_PERIODS):
                        copies.step(direction * control, DECISION_PERIOD_S)
            found = np.where(copies.valid, misfit(copies), np.inf)
            self.at = int(np.argmin(found))
            best = float(found[self.at])
            if best <= _NEAR_ENOUGH:
                break
            if number < _ROUNDS - 1:
                copies.copy_worlds(np.full(count, self.at))
        return best

    def _draw(self) -> Float[np.ndarray, "copies devices 2"]:
        """Draw a control for each copy: the next ones go ever farther, and the first stays where it is."""
        random, (count, devices) = self._random, (self.simulator.worlds, self.simulator.devices)
        share, drawn = np.arange(count)[:, None, None] / count, random.uniform(-1.0, 1.0, (count, devices, 2))
        control = share * drawn * [limits.fastest for limits in self._limits]
        control[:, 1:] *= random.random((count, devices - 1, 1)) > _REST_SHARE
        control[..., 1] = np.clip(control[..., 1], -_TURN_RAD_S, _TURN_RAD_S)
        lengths = self.simulator.at_drive[..., 0]
        for device, limits in enumerate(self._limits):
            control[:, device] = limits.clip(control[:, device], lengths[:, device], _PERIODS * DECISION_PERIOD_S)
        return control
