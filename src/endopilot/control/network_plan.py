"""Plans by a trained run: desired tips into the inverse network, whose controls the forward one follows.

The networks need 30 states before the first that they predict. A plan begins with a wire at rest, so 15 s of rest come
before it.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from jaxtyping import Float

from endopilot.control.plan_config import Steps
from endopilot.models.checkpoint import load_model
from endopilot.models.config import WINDOW
from endopilot.models.episodes import Episodes
from endopilot.progress import progress
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.simulator import Simulator
from endopilot.tasks.navigation import Navigation


def network_planner(navigation: Navigation, run: Path, desired: Steps) -> Callable[[], tuple[Steps, Steps]]:
    """Load networks; return a function that finds controls and predicts their tips.

    Args:
        navigation: what is to be done.
        run: made by `endopilot train`.
        desired: tips (Δtip, γtip), mm.

    Raises:
        InputError: the run is unfinished or damaged, or has not both networks.
    """
    predictor = load_model(run)
    episodes = RestingStart(navigation).episodes(desired[None], np.zeros((1, len(desired), 2)))

    def find() -> tuple[Steps, Steps]:
        with progress("plan: inverse network", total=1) as advance:
            found = predictor.rollout_dual(episodes)
            advance()
        return found.control[0], found.tip[0]

    return find


class RestingStart:
    """A wire at rest at the start of a navigation, as the given states of episodes.

    Attributes:
        navigation: what is to be done.
        tip: (Δtip, γtip) at rest, mm.
    """

    def __init__(self, navigation: Navigation) -> None:
        """Simulate the wire at rest."""
        self.navigation, config = navigation, SimulatorConfig(threads=1)
        simulator = Simulator(navigation.anatomy, navigation.device, config=config)
        simulator.reset(inserted_length=[navigation.start_inserted_length_mm], rotation=[navigation.start_rotation_rad])
        tip = simulator.project()[:, 0]
        self.tip = np.array([tip.abscissa[0], tip.offset[0]])

    def episodes(self, tips: Float[np.ndarray, "n s 2"], control: Float[np.ndarray, "n s 2"]) -> Episodes:
        """Return episodes of 15 s of rest and then some tips (mm) and controls (mm/s, rad/s)."""
        rest = np.zeros((len(tips), WINDOW, 2))
        return Episodes.of_controls(
            self.navigation.anatomy,
            self.navigation.device,
            initial=np.array([self.navigation.start_inserted_length_mm, self.navigation.start_rotation_rad]),
            control=np.concatenate([rest, control], axis=1),
            tip=np.concatenate([rest + self.tip, tips], axis=1),
        )
