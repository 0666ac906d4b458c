"""Windows of 30 states cut out of episodes: what a network is given, and the sample that it must predict."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from endopilot.models.config import WINDOW
from endopilot.models.episodes import Episodes


@dataclass(frozen=True, eq=False)
class Windows:
    """Episodes as the paper's networks take them: tensors, out of which windows are cut.

    Attributes:
        tip: (Δtip, γtip), mm.
        proximal: x^prox = (Δ mm, φ rad).
        control: π = (mm/s, rad/s).
    """

    tip: Float[Tensor, "episodes samples 2"]
    proximal: Float[Tensor, "episodes samples 2"]
    control: Float[Tensor, "episodes samples 2"]

    @staticmethod
    def of(episodes: Episodes) -> Windows:
        """Return the windows of some episodes."""
        signals = (episodes.tip, episodes.proximal, episodes.control)
        return Windows(*(torch.as_tensor(signal, dtype=torch.float32) for signal in signals))

    def targets(self) -> Int[Tensor, "windows 2"]:
        """Return (episode, sample) of every sample that has a whole window before it."""
        episodes, samples = self.tip.shape[:2]
        return torch.cartesian_prod(torch.arange(episodes), torch.arange(WINDOW, samples))

    def window(self, network: str, target: Int[Tensor, "b 2"]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return tip, proximal and control of the windows before some targets, and the truth there.

        FF is given tips up to the sample before the target and motions up to the target, and predicts the tip; IF is
        given motions up to the sample before the target and tips up to the target, and predicts the control (see
        `transformer`).
        """
        episode, sample = target[:, :1], target[:, 1:]
        before = sample + torch.arange(-WINDOW, 0)
        tip_at, motion_at = (before, before + 1) if network == "ff" else (before + 1, before)
        truth = self.tip if network == "ff" else self.control
        return (
            self.tip[episode, tip_at],
            self.proximal[episode, motion_at],
            self.control[episode, motion_at],
            truth[target[:, 0], target[:, 1]],
        )
