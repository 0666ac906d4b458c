"""The paper's pair (Kim et al. 2023, arXiv 2304.09286): FF, IF and their rollouts; `train` trains them.

FF predicts the tip from the drive's motion, IF the drive's motion from the desired tip, each from the last 30 states
by a Transformer of 4 + 4 layers with 12 heads. What the paper leaves open is decided as follows.

* d_model is 96, which 12 heads divide. The decoder's query is the newest token; layers normalise before each block.
* A token holds nine numbers, each standardised over the training windows: the slack s = Δ − Δtip, absolute and relative
  to the newest token; γtip; Δ; sin φ; cos φ; φ relative to the newest token; and π. Only sine, cosine and differences
  of φ enter, so a full turn of the whole history changes nothing.
* Each network's output is the change against a simple guess, in units of that change's root mean square: for FF the
  guess is that slack and offset stay as they are, for IF that the drive moves as the tip is to move, without turning.
* The loss is the mean square error in these units, both components alike.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from endopilot.devices.drive_limits import DriveLimits
from endopilot.models.config import WINDOW, TransformerConfig
from endopilot.models.episodes import Episodes, OpenLoop, Steps2, needed
from endopilot.types import SAMPLE_PERIOD_S

N_FEATURES = 9


class Network(nn.Module):
    """What FF and IF share: the Transformer, and the scales of what goes in and out.

    Buffers `feature_mean`, `feature_scale` and `output_scale` are part of the checkpoint; `fit_scales` sets them from
    training windows.
    """

    def __init__(self, config: TransformerConfig):
        super().__init__()
        self.embedding = nn.Linear(N_FEATURES, config.d_model)
        self.register_buffer("position", sinusoids(WINDOW, config.d_model), persistent=False)
        self.dropout = nn.Dropout(config.dropout)
        size = config.d_model, config.heads
        block = {"dim_feedforward": config.feedforward, "dropout": config.dropout, "batch_first": True}
        layer, norm = nn.TransformerEncoderLayer(*size, **block, norm_first=True), nn.LayerNorm(config.d_model)
        encoder = nn.TransformerEncoder(layer, config.encoder_layers, norm, enable_nested_tensor=False)
        layers = config.encoder_layers, config.decoder_layers
        self.transformer = nn.Transformer(*size, *layers, **block, norm_first=True, custom_encoder=encoder)
        self.head = nn.Linear(config.d_model, 2)
        nn.init.zeros_(self.head.weight)  # an untrained network is the simple guess
        nn.init.zeros_(self.head.bias)
        self.register_buffer("feature_mean", torch.zeros(N_FEATURES))
        self.register_buffer("feature_scale", torch.ones(N_FEATURES))
        self.register_buffer("output_scale", torch.ones(2))

    position: Tensor
    feature_mean: Tensor
    feature_scale: Tensor
    output_scale: Tensor

    def features(self, tip: Tensor, proximal: Tensor, control: Tensor) -> Tensor:
        """Return the window's tokens before scaling."""
        slack, angle = proximal[..., 0] - tip[..., 0], proximal[..., 1]
        turned = torch.sin(angle), torch.cos(angle), angle - angle[:, -1:]
        of_drive = control[..., 0], control[..., 1]
        return torch.stack([slack, slack - slack[:, -1:], tip[..., 1], proximal[..., 0], *turned, *of_drive], dim=-1)

    def guess(self, tip: Tensor, proximal: Tensor, control: Tensor) -> Tensor:
        """Return the simple guess of the output that the network corrects."""
        raise NotImplementedError

    def forward(
        self,
        tip: Float[Tensor, "b window 2"],
        proximal: Float[Tensor, "b window 2"],
        control: Float[Tensor, "b window 2"],
    ) -> Float[Tensor, "b 2"]:
        """Return the prediction in physical units.

        Args:
            tip: (Δtip, γtip), mm.
            proximal: x^prox = (Δ mm, φ rad).
            control: π = (mm/s, rad/s).
        """
        features = (self.features(tip, proximal, control) - self.feature_mean) / self.feature_scale
        tokens = self.dropout(self.embedding(features) + self.position)
        output = self.head(self.transformer(tokens, tokens[:, -1:]))[:, 0]
        return self.guess(tip, proximal, control) + self.output_scale * output

    def loss(self, prediction: Float[Tensor, "b 2"], truth: Float[Tensor, "b 2"]) -> Float[Tensor, ""]:
        """Return the mean square error in units of the simple guess's error."""
        return (((prediction - truth) / self.output_scale) ** 2).mean()

    @torch.no_grad()
    def fit_scales(self, tip: Tensor, proximal: Tensor, control: Tensor, truth: Tensor) -> None:
        """Set the scales from training windows."""
        features = self.features(tip, proximal, control).flatten(0, 1).double()
        self.feature_mean.copy_(features.mean(dim=0))
        self.feature_scale.copy_(features.std(dim=0).clamp_min(1e-6))
        change = (truth - self.guess(tip, proximal, control)).double()
        self.output_scale.copy_((change**2).mean(dim=0).sqrt().clamp_min(1e-6))


class ForwardNetwork(Network):
    """FF: token i holds (Δtip, γtip)_i, x^prox_{i+1}, π_{i+1} for i = t−29..t; the output is (Δtip, γtip)_{t+1}, mm."""

    def guess(self, tip: Tensor, proximal: Tensor, control: Tensor) -> Tensor:
        """Return the tip if slack and offset stay as they are."""
        advance = torch.stack([SAMPLE_PERIOD_S * control[:, -1, 0], torch.zeros_like(tip[:, -1, 0])], dim=-1)
        return tip[:, -1] + advance


class InverseNetwork(Network):
    """IF: token i holds desired (Δtip, γtip)_{i+1}, x^prox_i, π_i for i = t−29..t; the output is π_{t+1}."""

    def guess(self, tip: Tensor, proximal: Tensor, control: Tensor) -> Tensor:
        """Return the control that moves the wire as the tip is to move, without turning it."""
        speed = (tip[:, -1, 0] - tip[:, -2, 0]) / SAMPLE_PERIOD_S
        return torch.stack([speed, torch.zeros_like(speed)], dim=-1)


NETWORKS: dict[str, type[Network]] = {"ff": ForwardNetwork, "if": InverseNetwork}


def sinusoids(length: int, width: int) -> Float[Tensor, "length width"]:
    """Return the positional encoding of Vaswani et al. 2017: sin and cos of position / 10000^(2k/width)."""
    rate = torch.exp(torch.arange(0, width, 2) * (-math.log(10000.0) / width))
    angle = torch.arange(length)[:, None] * rate
    return torch.stack([angle.sin(), angle.cos()], dim=-1).flatten(-2)


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
        """Return (episode, sample) of every sample that has a whole window of finite states before it."""
        whole = self.tip.isfinite().all(dim=-1).cumprod(dim=1).bool()
        whole[:, :WINDOW] = False
        return whole.nonzero()

    def window(self, network: str, target: Int[Tensor, "b 2"]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return tip, proximal and control of the windows before some targets, and the truth there.

        FF is given tips up to the sample before the target and motions up to the target, and predicts the tip; IF is
        given motions up to the sample before the target and tips up to the target, and predicts the control.
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


@dataclass(frozen=True, eq=False)
class TransformerPredictor:
    """The paper's pair of networks, which feed back on themselves after the 30 given states.

    In P3 IF proposes a control, FF predicts the tip that it leads to, and IF takes that tip in place of an X-ray image.

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
        return self._rollout(episodes, inverse=False, forward=True)

    def rollout_inverse(self, episodes: Episodes) -> OpenLoop:
        """P2: predict the controls that bring about the true tip."""
        return self._rollout(episodes, inverse=True, forward=False)

    def rollout_dual(self, episodes: Episodes) -> OpenLoop:
        """P3: predict the controls that bring about the true tip, and the tip that they lead to."""
        return self._rollout(episodes, inverse=True, forward=True)

    @torch.inference_mode()
    def _rollout(self, episodes: Episodes, *, forward: bool, inverse: bool) -> OpenLoop:
        """Roll out after the given states: controls by IF or the true ones, tips by FF or the true ones."""
        networks = (
            needed(self.forward, "forward") if forward else None,
            needed(self.inverse, "inverse") if inverse else None,
        )
        parts = []
        for first in range(0, len(episodes), self.batch_size):
            chosen = np.arange(first, min(first + self.batch_size, len(episodes)))
            batch = Windows.of(episodes.select(chosen))
            parts.append(_rollout_batch(*networks, self.limits, batch))
        return OpenLoop(*(np.concatenate(signal) for signal in zip(*parts, strict=True)))


def _rollout_batch(
    forward: Network | None, inverse: Network | None, limits: DriveLimits, batch: Windows
) -> tuple[Steps2, Steps2]:
    desired = batch.tip
    tip, control = desired.clone(), batch.control.clone()
    proximal = batch.proximal.double()  # float64, so that x^prox stays the integral of the controls
    for k in range(WINDOW, tip.shape[1]):
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
    return tip[:, WINDOW:].double().numpy(), control[:, WINDOW:].double().numpy()
