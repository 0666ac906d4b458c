"""Windows of 30 states cut out of episodes: what a network sees, and the sample that it must predict."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from endopilot.dataset.loader import Dataset
from endopilot.errors import InputError
from endopilot.models.config import WINDOW


@dataclass(frozen=True, eq=False)
class Episodes:
    """What the networks see of episodes, as tensors.

    Attributes:
        tip: (Δtip, γtip), mm.
        proximal: x^prox = (Δ mm, φ rad).
        control: π = (mm/s, rad/s).
    """

    tip: Float[Tensor, "episodes samples 2"]
    proximal: Float[Tensor, "episodes samples 2"]
    control: Float[Tensor, "episodes samples 2"]

    @staticmethod
    def of(dataset: Dataset) -> Episodes:
        """Return the episodes of a dataset.

        Raises:
            InputError: the episodes are no longer than a window.
        """
        check_length(dataset)
        return Episodes(
            tip=_tensor(dataset.tip_abscissa, dataset.tip_offset),
            proximal=_tensor(dataset.inserted_length, dataset.rotation),
            control=torch.as_tensor(dataset.control, dtype=torch.float32),
        )

    def targets(self) -> Int[Tensor, "windows 2"]:
        """Return (episode, sample) of every sample that has a whole window before it."""
        episodes, samples = self.tip.shape[:2]
        return torch.cartesian_prod(torch.arange(episodes), torch.arange(WINDOW, samples))

    def window(self, network: str, target: Int[Tensor, "b 2"]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return tip, proximal and control of the windows before some targets, and the truth there.

        FF is given tips up to the sample before the target and motions up to the target, and predicts the tip; IF the
        other way round (see `transformer`).
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


def check_length(dataset: Dataset) -> None:
    """Check that episodes are longer than the given states.

    Raises:
        InputError: they are not.
    """
    samples = dataset.valid.shape[1]
    if samples <= WINDOW:
        seconds = (WINDOW + 1) * dataset.sample_period_s
        raise InputError(
            f"{dataset.folder}: episodes of {samples} samples leave nothing to predict after {WINDOW} given ones; "
            f"make the dataset with seconds of {seconds:g} or more"
        )


def _tensor(first: np.ndarray, second: np.ndarray) -> Tensor:
    return torch.as_tensor(np.stack([first, second], axis=-1), dtype=torch.float32)
