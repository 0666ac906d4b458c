"""One decision period of simulated wires, with the largest wall force within it: `drive_period`."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from endopilot.simulation.simulator import Simulator
from endopilot.simulation.state import Step
from endopilot.tasks.navigation import DECISION_PERIOD_S

_LOOKS = 5
"""Times in a period at which forces are read: a tip that is caught presses harder until it snaps, within some tenths
of a second."""


def drive_period(simulator: Simulator, control: Float[np.ndarray, "worlds *devices 2"]) -> Step:
    """Drive all worlds for a decision period; a world that fails stays where it was.

    Args:
        simulator: of the wires.
        control: mm/s and rad/s of each wire, then of its catheters.

    Returns:
        The worlds at the end of the period, but with the largest `contact_force_max` within it.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # whoever searches sees in `valid` that a wire has failed
        steps = [simulator.step(control, DECISION_PERIOD_S / _LOOKS) for _ in range(_LOOKS)]
    return replace(steps[-1], contact_force_max=np.max([step.contact_force_max for step in steps], axis=0))
