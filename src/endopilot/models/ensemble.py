"""Simulated wires that differ in what is uncertain, and how likely each is: `Ensemble`.

They differ in friction, in the stiffness of the tip, and in how deep the ostium lies along the guiding catheter's axis.
The twin, and what the causal network starts from, replay the commands of whole navigations with them; the belief of an
agent follows a robot's encoders.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from functools import cached_property

import numpy as np
from jaxtyping import Float

from endopilot.devices.catheter import Catheter
from endopilot.devices.device import Device
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.motion import Motion
from endopilot.simulation.simulate import simulate
from endopilot.simulation.simulator import Simulator
from endopilot.types import Anatomy

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
        wire: Device,
        parameters: Float[np.ndarray, "members 3"],
        *,
        start: Float[np.ndarray, "members devices 2"],
        config: SimulatorConfig,
        motion: Motion | None = None,
        catheters: Sequence[Catheter] = (),
    ) -> None:
        """Take what all have in common, and in what they differ.

        Args:
            anatomy: the vessel.
            wire: as it is given.
            parameters: of each member.
            start: inserted length (mm) and rotation (rad) of each device as the encoders have it at the start.
            config: settings of the rod core.
            motion: how the vessel moves, as far as that is known.
            catheters: around each wire, from the inside out.
        """
        self.parameters, self._anatomy, self._wire = parameters, anatomy, wire
        self._config, self._motion, self._catheters = config, motion, tuple(catheters)
        self.wires = {
            factor: wire.with_tip(bend_rad=wire.tip_bend_rad, stiffness_factor=float(factor))
            for factor in np.unique(parameters[:, 1])
        }
        self._start = np.stack([self._deeper(start[..., 0]), start[..., 1]], axis=-1)
        self._friction = wire.friction * parameters[:, 0]

    @cached_property
    def simulator(self) -> Simulator:
        """The worlds of the members, at the start of the navigation before they are driven."""
        simulator = Simulator(
            self._anatomy,
            [self.wires[factor] for factor in self.parameters[:, 1]],
            catheters=self._catheters,
            motion=self._motion,
            config=self._config,
        )
        simulator.reset(
            inserted_length=self._start[:, 0, 0],
            rotation=self._start[:, 0, 1],
            friction=self._friction,
            catheter_inserted_length=self._start[:, 1:, 0],
        )
        return simulator

    def replay(self, command: Float[np.ndarray, "members samples 2"]) -> Float[np.ndarray, "members samples 2"]:
        """Drive every wire from the start as a robot was told to; return its tips (Δtip, γtip), mm.

        Args:
            command: mm/s and rad/s of each sample.

        Returns:
            The tips at the end of each sample; NaN from where a simulation fails.
        """
        tips = np.full(command.shape, np.nan)
        for factor, wire in self.wires.items():
            chosen = self.parameters[:, 1] == factor
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # a member that fails is left out
                rollout = simulate(
                    self._anatomy,
                    wire,
                    command[chosen],
                    initial=self._start[chosen, 0],
                    config=self._config,
                    friction=self._friction[chosen],
                    motion=self._motion,
                )
            tip = np.stack([rollout.tip.abscissa, rollout.tip.offset], axis=-1)
            tips[chosen] = np.where(rollout.valid[..., None], tip, np.nan)
        return tips

    def _deeper(self, given_mm: Float[np.ndarray, "members *devices"]) -> Float[np.ndarray, "members *devices"]:
        """Return inserted lengths from each member's ostium on, mm, of those from the given one on."""
        ostium_mm = self.parameters[:, 2].reshape(-1, *[1] * (given_mm.ndim - 1))
        return np.maximum(given_mm + ostium_mm, 0.0)


def likelihoods(score: Float[np.ndarray, "members *n"]) -> Float[np.ndarray, "members *n"]:
    """Return how likely members are, in the sum 1, from their logarithmic likelihoods up to a constant."""
    weight = np.exp(score - score.max(axis=0))
    return weight / weight.sum(axis=0)
