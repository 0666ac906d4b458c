"""Plans by a trained run: desired tips into the inverse network, whose controls the forward one follows."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from endopilot.control.plan_config import Steps
from endopilot.models.checkpoint import load_model
from endopilot.models.config import WINDOW
from endopilot.models.episodes import Episodes
from endopilot.progress import progress
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.simulator import Simulator
from endopilot.tasks.navigation import Navigation


def plan_by_networks(navigation: Navigation, run: Path, desired: Steps) -> tuple[Steps, Steps]:
    """Return the controls (mm/s, rad/s) of a trained run for desired tips, and the tips that it predicts, mm.

    The networks need 30 states before the first that they predict. A plan begins with a wire at rest, so 15 s of rest
    come before it.

    Raises:
        InputError: the run is unfinished or damaged, or has not both networks.
    """
    predictor, config = load_model(run), SimulatorConfig(threads=1)
    simulator = Simulator(navigation.anatomy, navigation.device, config=config)
    simulator.reset(inserted_length=navigation.start[:, 0], rotation=navigation.start[:, 1])
    tip, rest = simulator.project(), np.zeros((1, WINDOW, 2))
    at_rest = np.tile([tip.abscissa[0, 0], tip.offset[0, 0]], (1, WINDOW, 1))
    episodes = Episodes.of_controls(
        navigation.anatomy,
        navigation.device,
        initial=navigation.start[0],
        control=np.concatenate([rest, np.zeros((1, *desired.shape))], axis=1),
        tip=np.concatenate([at_rest, desired[None]], axis=1),
    )
    with progress("plan: inverse network", total=1) as advance:
        found = predictor.rollout_dual(episodes)
        advance()
    return found.control[0], found.tip[0]
