"""What worlds are simulated with: `SimulationSetUp`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from endopilot.devices.stack import Stack
from endopilot.simulation.config import Actuation, SimulatorConfig
from endopilot.simulation.motion import Motion
from endopilot.types import Anatomy


@dataclass(frozen=True, eq=False)
class SimulationSetUp:
    """What worlds are simulated with. A `Simulator` made of it and the same commands give the same bits.

    Attributes:
        anatomies: the vessel of each world.
        stacks: the devices of each world.
        initial: Δ (mm) and φ (rad) that the devices are brought to before the first command; NaN in a world that was
            on its way already.
        friction: Coulomb coefficient of each device on the wall.
        actuation: what commands are: "velocity" (mm/s, rad/s) or "force" (N, N·mm).
        motion: how every vessel moves with time; None where they lie still.
        config: settings of the rod core.
    """

    anatomies: Sequence[Anatomy]
    stacks: Sequence[Stack]
    initial: Float[np.ndarray, "worlds devices 2"]
    friction: Float[np.ndarray, "worlds devices"]
    actuation: Actuation
    motion: Motion | None
    config: SimulatorConfig

    @property
    def largest(self) -> Float[np.ndarray, "worlds devices 2"]:
        """Largest magnitudes that commands may have: mm/s and rad/s, or N and N·mm, with a hair for rounding."""
        fastest = np.array([stack.fastest for stack in self.stacks]) * (1 + 1e-6)
        return np.full_like(fastest, np.finfo(float).max) if self.actuation == "force" else fastest
