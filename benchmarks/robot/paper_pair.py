"""The paper's forward network (Kim et al. 2023) trained on a real robot's logs, in place of simulated navigations.

A state is a tip that was seen: (Δtip, signed side) as (Δtip, γtip), the drive's command as x^prox. An episode whose
given part is shorter than the 30 states that the paper gives begins at rest for as long as is missing.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from endopilot.models.config import WINDOW, TrainConfig
from endopilot.models.paper import Network, Windows
from endopilot.models.train import Job
from endopilot.types import SAMPLE_PERIOD_S


@dataclass(frozen=True, eq=False)
class States:
    """The states of one episode.

    Attributes:
        session: name of its log.
        tip: (Δtip, side) of the real tip, mm.
        drive: place that the drive was commanded to then, mm and rad; 0 mm is where Δtip is 0 without slack at first.
        given: number of tips that are given.
    """

    session: str
    tip: Float[np.ndarray, "tips 2"]
    drive: Float[np.ndarray, "tips 2"]
    given: int


def windows(episodes: Sequence[States]) -> tuple[Windows, list[int]]:
    """Return episodes of one length, with rest before and nothing known after, and the length of each one's rest."""
    rest = [max(0, WINDOW - each.given) for each in episodes]
    longest = max(len(each.tip) + more for each, more in zip(episodes, rest, strict=True))
    tip, drive = np.full((len(episodes), longest, 2), np.nan), np.zeros((len(episodes), longest, 2))
    for k, (each, more) in enumerate(zip(episodes, rest, strict=True)):
        rows = slice(more, more + len(each.tip))
        tip[k, :more], drive[k, :more], tip[k, rows], drive[k, rows] = each.tip[0], each.drive[0], each.tip, each.drive
        drive[k, rows.stop :] = each.drive[-1]
    control = np.diff(drive, axis=1, prepend=drive[:, :1]) / SAMPLE_PERIOD_S
    return Windows(*(torch.as_tensor(each, dtype=torch.float32) for each in (tip, drive, control))), rest


def predict_left_out(
    episodes: Sequence[States], teachers: Mapping[str, Sequence[str]], *, epochs: int
) -> list[Float[np.ndarray, "tips 2"]]:
    """Return (Δtip, side) of each episode: given ones, then what a network predicts.

    Args:
        teachers: by the session of an episode, those which its network is trained on.
        epochs: of the training.
    """
    found: dict[int, np.ndarray] = {}
    for name in dict.fromkeys(each.session for each in episodes):
        training, _ = windows([each for each in episodes if each.session in teachers[name]])
        with tempfile.TemporaryDirectory() as folder:
            config = TrainConfig(network="ff", epochs=epochs, batch_size=64, processor="cpu")
            network, _ = Job("ff", config, training, None, Path(folder)).run()
        found |= _rolled_out(network, {k: each for k, each in enumerate(episodes) if each.session == name})
    return [found[k] for k in range(len(episodes))]


@torch.inference_mode()
def _rolled_out(network: Network, episodes: dict[int, States]) -> dict[int, np.ndarray]:
    of, rest = windows(list(episodes.values()))
    begin = torch.tensor([max(each.given, WINDOW) for each in episodes.values()])
    for k in range(WINDOW, of.tip.shape[1]):
        moved = slice(k - WINDOW + 1, k + 1)
        new = network(of.tip[:, k - WINDOW : k], of.proximal[:, moved], of.control[:, moved])
        of.tip[:, k] = torch.where((k < begin)[:, None], of.tip[:, k], new)
    pairs = zip(episodes.items(), rest, strict=True)
    return {k: of.tip[row, more : more + len(each.tip)].numpy() for row, ((k, each), more) in enumerate(pairs)}
