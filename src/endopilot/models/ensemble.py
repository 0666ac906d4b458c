"""Simulated wires that differ in what is uncertain, and how likely each is: `Ensemble`.

They differ in friction, in the stiffness of the tip, and in how deep the ostium lies along the guiding catheter's axis.
The twin, and what the causal network starts from, replay the commands of whole navigations with them; the belief of an
agent follows a robot's encoders.
"""

from __future__ import annotations

import warnings
from dataclasses import replace
from functools import cached_property

import numpy as np
from jaxtyping import Float

from endopilot.devices.device import Wire
from endopilot.devices.stack import Stack
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.motion import Motion
from endopilot.simulation.simulate import run_set_up
from endopilot.simulation.simulator import Simulator
from endopilot.simulation.state import SimulationSetUp
from endopilot.types import SAMPLE_PERIOD_S, Anatomy

NOMINAL = np.array([1.0, 1.0, 0.0])
"""Friction factor, tip stiffness factor and depth of the ostium (mm) of a wire that is as it is given."""


class Ensemble:
    """Wires of one patient that differ in what is uncertain, each in catheters if there are any.

    Attributes:
        parameters: friction factor, tip stiffness factor and depth of the ostium (mm) of each member.
        wires: the wires by the stiffness factor of their tip; members share them.
    """

    def __init__(
        self,
        anatomy: Anatomy,
        device: Wire | Stack,
        parameters: Float[np.ndarray, "members 3"],
        *,
        start: Float[np.ndarray, "members devices 2"],
        config: SimulatorConfig,
        motion: Motion | None = None,
    ) -> None:
        """Take what all have in common, and in what they differ.

        Args:
            device: the wire as it is given, or the wire and its catheters.
            start: inserted length (mm) and rotation (rad) of each device as the encoders have it at the start.
        """
        stack, self.parameters = Stack.of(device), parameters
        wire = stack.wire
        self.wires = with_stiffnesses(wire, parameters[:, 1])
        self.set_up = SimulationSetUp(
            anatomies=[anatomy] * len(parameters),
            stacks=[replace(stack, wire=self.wires[factor]) for factor in parameters[:, 1]],
            initial=np.stack([np.maximum(start[..., 0] + parameters[:, 2:], 0.0), start[..., 1]], axis=-1),
            friction=stack.frictions(wire.friction * parameters[:, 0]),
            actuation="velocity",
            motion=motion,
            config=config,
        )

    @cached_property
    def simulator(self) -> Simulator:
        """The worlds of the members, at the start of the navigation before they are driven."""
        return self.started()

    def started(self, reach_mm: float = 0.0) -> Simulator:
        """Return the worlds of the members at the start of the navigation, laid out for an inserted length, mm."""
        given = self.set_up
        layout = {"motion": given.motion, "config": given.config, "reach_mm": reach_mm}
        simulator = Simulator(given.anatomies, given.stacks, **layout)
        simulator.reset(inserted_length=given.initial[..., 0], rotation=given.initial[..., 1], friction=given.friction)
        return simulator

    def replay(self, command: Float[np.ndarray, "members samples 2"]) -> Float[np.ndarray, "members samples 2"]:
        """Drive every wire from the start as a robot was commanded; return its tips (Δtip, γtip), mm.

        Args:
            command: mm/s and rad/s of each sample.

        Returns:
            The tips at the end of each sample; NaN from where a simulation fails.
        """
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a member that fails is left out
            made = run_set_up(self.set_up, command[:, :, None], period_s=SAMPLE_PERIOD_S, record_shape=False)
        tip = made.tip[:, :, 0]
        return np.where(made.valid[..., None], np.stack([tip.abscissa, tip.offset], axis=-1), np.nan)


def with_stiffnesses(wire: Wire, factors: Float[np.ndarray, "n"]) -> dict[float, Wire]:
    """Return a wire with its tip as many times as stiff as some factors say, by the factor; equal ones are one wire."""
    return {
        each: wire.with_tip(bend_rad=wire.tip_bend_rad, stiffness_factor=each) for each in np.unique(factors).tolist()
    }


def likelihoods(score: Float[np.ndarray, "members *n"]) -> Float[np.ndarray, "members *n"]:
    """Return how likely members are, in the sum 1, from their logarithmic likelihoods up to a constant."""
    weight = np.exp(score - score.max(axis=0))
    return weight / weight.sum(axis=0)
