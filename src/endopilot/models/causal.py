"""The causal networks: from the vessel and the whole past they correct the prediction of the play operator.

FF predicts (Δtip, γtip) from the drive's motion, IF the drive's motion from the desired tip. Both are one network with
the roles exchanged (`play`). Its inputs at every sample are the vessel around the tip, the push–pull envelopes, the
play operator between them, and what was observed a sample ago; a recurrent layer carries the past. Its outputs are the
change against the play operator's guess and an estimate of its own error:

    inputs -> two dense layers -> GRU -> two dense layers -> median and scale b of a Laplace distribution

The loss is the negative logarithm of that distribution's density plus the absolute error in units of its mean over the
training data, so that rare snaps, which the density forgives, count as well. Nothing feeds back: the network is run
once over all controls, and the output at a sample depends on nothing that comes after it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from weakref import WeakKeyDictionary

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from endopilot.errors import InputError
from endopilot.models.config import WINDOW, CausalConfig
from endopilot.models.episodes import Episodes, Setup
from endopilot.models.open_loop import EachObserved, Observed, OpenLoop, Prediction, Steps2, begin_after, given_states
from endopilot.models.play import Direction, Vessels
from endopilot.models.sequences import N_INPUTS, prepare_vessels, unfold
from endopilot.simulation.drive_limits import DriveLimits
from endopilot.types import SAMPLE_PERIOD_S

_GIVEN_WEIGHT = 0.3
"""Weight of the loss over the first 30 samples, where the tip was observed a sample ago."""
_LEAST_SCALE = 0.05
"""Smallest scale of the distribution, in units of the mean absolute change."""
_FARTHEST = 6.0
"""Inputs are clipped to this many standard deviations, so that an unusual vessel cannot lead the network far astray."""
_REFINEMENTS = 6
"""Times that P3 corrects the controls by the tip that FF predicts from them."""


class CausalNetwork(nn.Module):
    """The network; FF and IF are two of the same kind.

    Buffers `input_mean`, `input_scale` and `output_scale` are part of the checkpoint; `fit_scales` sets them.
    """

    def __init__(self, config: CausalConfig):
        super().__init__()
        width = config.width
        self.embedding = nn.Sequential(
            nn.Linear(N_INPUTS, width), nn.GELU(), nn.Dropout(config.drop_share), nn.Linear(width, width)
        )
        self.memory = nn.GRU(width, width, config.layers, batch_first=True)
        self.head = nn.Sequential(
            nn.LayerNorm(2 * width), nn.Linear(2 * width, width), nn.GELU(), nn.Dropout(config.drop_share)
        )
        self.output = nn.Linear(width, 4)
        nn.init.zeros_(self.output.weight)  # an untrained network is the play operator
        nn.init.zeros_(self.output.bias)
        self.register_buffer("input_mean", torch.zeros(N_INPUTS))
        self.register_buffer("input_scale", torch.ones(N_INPUTS))
        self.register_buffer("output_scale", torch.ones(2))

    input_mean: Tensor
    input_scale: Tensor
    output_scale: Tensor

    def forward(self, inputs: Float[Tensor, "b samples inputs"]) -> Float[Tensor, "b samples 4"]:
        """Return the medians of both changes, and the scales b of their Laplace distributions."""
        scaled = ((inputs - self.input_mean) / self.input_scale).clamp(-_FARTHEST, _FARTHEST)
        tokens = self.embedding(scaled)
        carried, _ = self.memory(tokens)
        out = self.output(self.head(torch.cat([carried, tokens], dim=-1)))
        scale = F.softplus(out[..., 2:]) + _LEAST_SCALE
        return torch.cat([out[..., :2] * self.output_scale, scale * self.output_scale], dim=-1)

    def fit_scales(self, inputs: Float[Tensor, "b samples inputs"], change: Float[Tensor, "b samples 2"]) -> None:
        """Set the scales from training data."""
        flat = inputs.flatten(0, 1)
        self.input_mean.copy_(flat.mean(dim=0))
        self.input_scale.copy_(flat.std(dim=0).clamp(min=1e-3))
        self.output_scale.copy_(change[:, WINDOW:].abs().mean(dim=(0, 1)).clamp(min=1e-6))

    def loss(self, output: Float[Tensor, "b samples 4"], change: Float[Tensor, "b samples 2"]) -> Float[Tensor, ""]:
        """Return −log density of the Laplace distribution, plus the absolute error, in units of the mean change."""
        error = (output[..., :2] - change).abs()
        scale = output[..., 2:]
        each = error / scale + (scale / self.output_scale).log() + error / self.output_scale
        weight = torch.ones(change.shape[1], 1, device=change.device)
        weight[:WINDOW] = _GIVEN_WEIGHT
        return (weight * each).mean()


CAUSAL_NETWORKS: dict[str, type[CausalNetwork]] = {"ff": CausalNetwork, "if": CausalNetwork}


@dataclass(frozen=True, eq=False)
class CausalPredictor:
    """The pair of causal networks.

    Attributes:
        forward: FF, if it was trained.
        inverse: IF, if it was trained.
        limits: of the drive.
        prepared: names and tables of the patients of each setup that it has predicted in.
    """

    forward: CausalNetwork | None
    inverse: CausalNetwork | None
    limits: DriveLimits
    prepared: WeakKeyDictionary[Setup, tuple[tuple[str, ...], Vessels]] = field(
        default_factory=WeakKeyDictionary, repr=False
    )

    def predict(self, episodes: Episodes, observed: Observed | EachObserved) -> Prediction:
        """Predict the tips of episodes from their controls and from the observed tips.

        Args:
            episodes: their controls, and their tips where `observed`; no other tip is read.
            observed: samples at which the tip was observed, of all episodes alike or of each.
        """
        network = _needed(self.forward, "forward")
        given = np.broadcast_to(observed, episodes.branch.shape)
        guess, output = self._run(network, "forward", episodes, given)
        tip = np.where(given[..., None], episodes.tip.astype(float), guess + output[..., :2])
        spread = np.where(given[..., None], 0.0, math.sqrt(2.0) * output[..., 2:])
        return Prediction(tip, spread)

    def rollout_forward(self, episodes: Episodes) -> OpenLoop:
        """P1: predict the tip under the true controls."""
        tip = self.predict(episodes, given_states(episodes)).tip
        later = slice(WINDOW, None)
        return OpenLoop(
            tip[:, later], episodes.proximal[:, later].astype(float), episodes.control[:, later].astype(float)
        )

    def rollout_inverse(self, episodes: Episodes) -> OpenLoop:
        """P2: predict the controls that bring about the true tip."""
        length, turn = self._wanted_motion(episodes, WINDOW)
        proximal, control = _driven(episodes, length, turn, self.limits)
        return OpenLoop(episodes.tip[:, WINDOW:].astype(float), proximal, control)

    def rollout_dual(self, episodes: Episodes, observed: Observed | None = None) -> OpenLoop:
        """P3: predict the controls that bring about the true tip, and the tip that they lead to.

        IF proposes controls and FF predicts their tip. Then the inserted length of every sample is corrected by the
        difference between the desired and the predicted tip, a few times over. No control depends on a later desired
        tip.
        """
        observed = given_states(episodes) if observed is None else observed
        begin = begin_after(observed)
        desired = episodes.tip[:, begin:, 0].astype(float)
        length, turn = self._wanted_motion(episodes, begin)
        proximal, control = _driven(episodes, length, turn, self.limits)
        tip = self.predict(episodes.driven(proximal, control), observed).tip[:, begin:]
        for _ in range(_REFINEMENTS):
            length = proximal[..., 0] + desired - tip[..., 0]
            proximal, control = _driven(episodes, length, turn, self.limits)
            tip = self.predict(episodes.driven(proximal, control), observed).tip[:, begin:]
        return OpenLoop(tip, proximal, control)

    def _wanted_motion(self, episodes: Episodes, begin: int) -> tuple[np.ndarray, np.ndarray]:
        """Return IF's inserted length (mm) and turn (rad) of every sample from `begin` on."""
        network = _needed(self.inverse, "inverse")
        given = np.broadcast_to(np.arange(episodes.samples) < begin, episodes.branch.shape)
        guess, output = self._run(network, "inverse", episodes, given)
        wanted = (guess + output[..., :2])[:, begin:]
        return wanted[..., 0], wanted[..., 1]

    @torch.inference_mode()
    def _run(
        self,
        network: CausalNetwork,
        direction: Direction,
        episodes: Episodes,
        observed: Bool[np.ndarray, "episodes samples"],
    ) -> tuple[Float[np.ndarray, "episodes samples 2"], Float[np.ndarray, "episodes samples 4"]]:
        """Return the play operator's guess and the network's output for episodes."""
        vessels, patient = self._vessels(episodes)
        unfolded = unfold(direction, vessels, patient, episodes, observed)
        return unfolded.guess, network(torch.as_tensor(unfolded.inputs)).double().numpy()

    def _vessels(self, episodes: Episodes) -> tuple[Vessels, Int[np.ndarray, "episodes"]]:
        """Return the tables of the episodes' patients, perhaps of others too, and which row each episode has."""
        names, vessels = self.prepared.get(episodes.setup, ((), None))
        if vessels is None or not set(episodes.anatomy.tolist()) <= set(names):
            names, vessels = tuple(np.unique(episodes.anatomy).tolist()), prepare_vessels(episodes)
            self.prepared[episodes.setup] = names, vessels
        return vessels, np.searchsorted(names, episodes.anatomy)


def _needed(network: CausalNetwork | None, role: str) -> CausalNetwork:
    if network is None:
        raise InputError(f"the run has no {role} network; train it with --network both")
    return network


def _driven(
    episodes: Episodes,
    length: Float[np.ndarray, "episodes samples"],
    turn: Float[np.ndarray, "episodes samples"],
    limits: DriveLimits,
) -> tuple[Steps2, Steps2]:
    """Return x^prox and control of a drive that follows the last lengths and turns as far as it can."""
    control = np.empty((*length.shape, 2))
    start = episodes.proximal[:, -length.shape[1] - 1].astype(float)
    inserted = start[:, 0]
    for t in range(length.shape[1]):
        wanted = np.column_stack([length[:, t] - inserted, turn[:, t]]) / SAMPLE_PERIOD_S
        control[:, t] = limits.clip(wanted, inserted, SAMPLE_PERIOD_S)
        inserted = inserted + SAMPLE_PERIOD_S * control[:, t, 0]
    return start[:, None] + SAMPLE_PERIOD_S * np.cumsum(control, axis=1), control
