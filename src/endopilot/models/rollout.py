"""Open-loop rollouts of the paper's networks, which feed back on themselves after the 30 given states.

In P3 IF proposes a control, FF predicts the tip that it leads to, and IF takes that tip in place of an X-ray image.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from endopilot.devices.device import Wire
from endopilot.devices.drive_limits import DriveLimits
from endopilot.errors import InputError
from endopilot.files import reading
from endopilot.models.causal import CausalPredictor
from endopilot.models.checkpoint import read_network
from endopilot.models.config import PRETRAINED, WINDOW, TwinConfig, read_run, run_path
from endopilot.models.episodes import Episodes
from endopilot.models.open_loop import Observed, OpenLoop, Predictor, Steps2, begin_after
from endopilot.models.transformer import Network, Windows
from endopilot.models.twin import TwinPredictor
from endopilot.settings import from_record
from endopilot.simulation.config import SimulatorConfig
from endopilot.types import SAMPLE_PERIOD_S


@dataclass(frozen=True, eq=False)
class TransformerPredictor:
    """The paper's pair of networks.

    Attributes:
        forward: FF, if it was trained.
        inverse: IF, if it was trained.
        limits: of the drive; IF's controls are clipped to them.
        batch_size: episodes that are rolled out together.
    """

    forward: Network | None
    inverse: Network | None
    limits: DriveLimits
    batch_size: int = 256

    def rollout_forward(self, episodes: Episodes) -> OpenLoop:
        """P1: predict the tip under the true controls."""
        return self._rollout(episodes, WINDOW, inverse=False, forward=True)

    def rollout_inverse(self, episodes: Episodes) -> OpenLoop:
        """P2: predict the controls that bring about the true tip."""
        return self._rollout(episodes, WINDOW, inverse=True, forward=False)

    def rollout_dual(self, episodes: Episodes, observed: Observed | None = None) -> OpenLoop:
        """P3: predict the controls that bring about the true tip, and the tip that they lead to.

        The networks take the last 30 states only; those not observed are as they were predicted at the time.
        """
        begin = WINDOW if observed is None else begin_after(observed)
        return self._rollout(episodes, begin, inverse=True, forward=True)

    @torch.inference_mode()
    def _rollout(self, episodes: Episodes, begin: int, *, forward: bool, inverse: bool) -> OpenLoop:
        """Roll out from a sample on: controls by IF or the true ones, tips by FF or the true ones."""
        networks = self._network("forward", forward), self._network("inverse", inverse)
        parts = []
        for first in range(0, len(episodes), self.batch_size):
            chosen = np.arange(first, min(first + self.batch_size, len(episodes)))
            batch = Windows.of(episodes.select(chosen))
            parts.append(_rollout_batch(*networks, self.limits, batch, begin))
        tip, proximal, control = (np.concatenate(signal) for signal in zip(*parts, strict=True))
        return OpenLoop(tip=tip, proximal=proximal, control=control)

    def _network(self, role: str, needed: bool) -> Network | None:
        network = getattr(self, role)
        if needed and network is None:
            raise InputError(f"the run has no {role} network; train it with --network both")
        return network if needed else None


def _rollout_batch(
    forward: Network | None, inverse: Network | None, limits: DriveLimits, batch: Windows, begin: int
) -> tuple[Steps2, Steps2, Steps2]:
    """Return tip, x^prox and control of one batch from a sample on."""
    desired = batch.tip
    tip, control = desired.clone(), batch.control.clone()
    proximal = batch.proximal.double()  # float64, so that x^prox stays the integral of the controls
    for k in range(begin, tip.shape[1]):
        if inverse is not None:
            wanted = torch.cat([tip[:, k - WINDOW + 1 : k], desired[:, k : k + 1]], dim=1)
            given = slice(k - WINDOW, k)
            proposed = inverse(wanted, proximal[:, given].float(), control[:, given])
            inserted = proximal[:, k - 1, 0].float()
            control[:, k] = torch.from_numpy(limits.clip(proposed.numpy(), inserted.numpy(), SAMPLE_PERIOD_S))
            proximal[:, k] = proximal[:, k - 1] + SAMPLE_PERIOD_S * control[:, k].double()
        if forward is not None:
            moved = slice(k - WINDOW + 1, k + 1)
            tip[:, k] = forward(tip[:, k - WINDOW : k], proximal[:, moved].float(), control[:, moved])
    return tuple(signal[:, begin:].double().numpy() for signal in (tip, proximal, control))  # pyright: ignore[reportReturnType]


def load_model(run: str | Path = PRETRAINED) -> Predictor:
    """Return the predictor of a run made by `endopilot train`, or the packaged one, named "pretrained".

    Raises:
        InputError: the run is unfinished, or a file of it is damaged or of another version.
    """
    record, run_folder = read_run(run), run_path(run)
    with reading(run_folder, "train anew"):
        return _predictor(record, run_folder)


def _predictor(record: dict[str, Any], run_folder: Path) -> Predictor:
    device = from_record(Wire, record["device"])
    if record["config"]["model"] == "twin":
        return TwinPredictor(
            device=device,
            simulator=SimulatorConfig(**record["simulator"]),
            config=TwinConfig(**record["config"]["twin"]),
        )
    files = {name: run_folder / f"{name}.safetensors" for name in record["networks"]}
    networks: dict[str, Any] = {name: read_network(file)[0] for name, file in files.items()}
    kind = CausalPredictor if record["config"]["model"] == "causal" else TransformerPredictor
    return kind(
        forward=networks.get("ff"),
        inverse=networks.get("if"),
        limits=DriveLimits.of(device),
    )
