"""Our networks: told of the vessel and of the whole past, they correct what the play operator foretells.

FF foretells (Δtip, γtip) from the drive's motion, IF the drive's motion from the desired tip. Both are one network
with the roles exchanged (`play`): at every sample it is told of the vessel around the tip, of the push–pull envelopes,
of the play operator between them, and of what was seen a sample ago; a recurrent layer carries the past. It answers
with the change against the play operator's guess, and with how sure it is:

    inputs -> two dense layers -> GRU -> two dense layers -> median and scale b of a Laplace distribution

The loss is the negative logarithm of that distribution's density plus the absolute error in units of its mean over the
training data, so that rare snaps, which the density forgives, count as well. Nothing feeds back: the network is run
once over all controls, and a sample's answer depends on nothing that comes after it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from endopilot.dataset.loader import Dataset
from endopilot.errors import InputError
from endopilot.models.config import WINDOW, CausalConfig
from endopilot.models.open_loop import EachObserved, Observed, OpenLoop, Prediction, Steps2, begin_after, given_states
from endopilot.models.play import Direction, Vessels
from endopilot.models.sequences import N_INPUTS, read_vessels, unfold
from endopilot.simulation.drive_limits import DriveLimits
from endopilot.types import SAMPLE_PERIOD_S

_GIVEN_WEIGHT = 0.3
"""Weight of the loss over the first 30 samples, where the tip was seen a sample ago."""
_LEAST_SCALE = 0.05
"""Smallest scale of the distribution, in units of the mean absolute change."""
_FARTHEST = 6.0
"""Inputs are clipped to this many standard deviations, so that an unseen vessel cannot drive the network far off."""
_REFINEMENTS = 6
"""Times that P3 corrects the controls by what FF foretells of them."""


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

    def loss(self, answer: Float[Tensor, "b samples 4"], change: Float[Tensor, "b samples 2"]) -> Float[Tensor, ""]:
        """Return −log density of the Laplace distribution, plus the absolute error, in units of the mean change."""
        miss = (answer[..., :2] - change).abs()
        scale = answer[..., 2:]
        each = miss / scale + (scale / self.output_scale).log() + miss / self.output_scale
        weight = torch.ones(change.shape[1], 1, device=change.device)
        weight[:WINDOW] = _GIVEN_WEIGHT
        return (weight * each).mean()


CAUSAL_NETWORKS: dict[str, type[CausalNetwork]] = {"ff": CausalNetwork, "if": CausalNetwork}


@dataclass(frozen=True, eq=False)
class CausalPredictor:
    """Our pair of networks.

    Attributes:
        forward: FF, if it was trained.
        inverse: IF, if it was trained.
        limits: of the drive.
        known: the patients that it has been asked about, by dataset and names.
    """

    forward: CausalNetwork | None
    inverse: CausalNetwork | None
    limits: DriveLimits
    known: dict[tuple[str, ...], Vessels] = field(default_factory=dict, repr=False)

    def foretell(self, episodes: Dataset, seen: Observed | EachObserved) -> Prediction:
        """Predict the tips of episodes under their controls, from those that were seen.

        Args:
            episodes: their controls, and the tips where `seen`; no other tip is looked at.
            seen: samples at which the tip was measured, for example by X-ray, of all episodes alike or of each.
        """
        network = _needed(self.forward, "forward")
        given = np.broadcast_to(seen, episodes.valid.shape)
        guess, answer = self._answered(network, "forward", episodes, given)
        true = np.stack([episodes.tip_abscissa, episodes.tip_offset], axis=-1).astype(float)
        tip = np.where(given[..., None], true, guess + answer[..., :2])
        spread = np.where(given[..., None], 0.0, math.sqrt(2.0) * answer[..., 2:])
        return Prediction(tip, spread)

    def rollout_forward(self, episodes: Dataset) -> OpenLoop:
        """P1: predict the tip under the true controls."""
        told = self.foretell(episodes, given_states(episodes))
        proximal = np.stack([episodes.inserted_length, episodes.rotation], axis=-1).astype(float)
        return OpenLoop(told.tip[:, WINDOW:], proximal[:, WINDOW:], episodes.control[:, WINDOW:].astype(float))

    def rollout_inverse(self, episodes: Dataset) -> OpenLoop:
        """P2: predict the controls that make the tip go the true way."""
        desired = np.stack([episodes.tip_abscissa, episodes.tip_offset], axis=-1).astype(float)[:, WINDOW:]
        length, turn = self._asked(episodes, WINDOW)
        proximal, control = _driven(episodes, length, turn, self.limits)
        return OpenLoop(desired, proximal, control)

    def rollout_dual(self, episodes: Dataset, seen: Observed | None = None) -> OpenLoop:
        """P3: predict the controls that make the tip go the true way, and the tip that they make.

        IF proposes controls, FF foretells what they do, and the inserted length is corrected at every sample by what
        the foretold tip misses the desired one by, a few times over. No control depends on a later desired tip.
        """
        seen = given_states(episodes) if seen is None else seen
        begin = begin_after(seen)
        desired = episodes.tip_abscissa[:, begin:].astype(float)
        length, turn = self._asked(episodes, begin)
        proximal, control = _driven(episodes, length, turn, self.limits)
        tip = self.foretell(_along(episodes, proximal, control), seen).tip[:, begin:]
        for _ in range(_REFINEMENTS):
            length = proximal[..., 0] + desired - tip[..., 0]
            proximal, control = _driven(episodes, length, turn, self.limits)
            tip = self.foretell(_along(episodes, proximal, control), seen).tip[:, begin:]
        return OpenLoop(tip, proximal, control)

    def _asked(self, episodes: Dataset, begin: int) -> tuple[np.ndarray, np.ndarray]:
        """Return inserted length (mm) and turn (rad) of every sample from `begin` on, as IF asks for them."""
        network = _needed(self.inverse, "inverse")
        given = np.broadcast_to(np.arange(episodes.valid.shape[1]) < begin, episodes.valid.shape)
        guess, answer = self._answered(network, "inverse", episodes, given)
        wanted = (guess + answer[..., :2])[:, begin:]
        return wanted[..., 0], wanted[..., 1]

    @torch.inference_mode()
    def _answered(
        self,
        network: CausalNetwork,
        direction: Direction,
        episodes: Dataset,
        seen: Bool[np.ndarray, "episodes samples"],
    ) -> tuple[Float[np.ndarray, "episodes samples 2"], Float[np.ndarray, "episodes samples 4"]]:
        """Return the play operator's guess and the network's answer for episodes."""
        vessels, patient = self._vessels(episodes)
        unfolded = unfold(direction, vessels, patient, episodes, seen)
        return unfolded.guess, network(torch.as_tensor(unfolded.inputs)).double().numpy()

    def _vessels(self, episodes: Dataset) -> tuple[Vessels, Int[np.ndarray, "episodes"]]:
        """Return the tables of the episodes' patients, perhaps of others too, and which row each episode has."""
        dataset, wanted = episodes.manifest["key"], set(episodes.anatomy.tolist())
        key = next((key for key in self.known if key[0] == dataset and wanted <= set(key[1:])), None)
        if key is None:
            key = (dataset, *sorted(wanted))
            self.known[key] = read_vessels(episodes)
        return self.known[key], np.searchsorted(key[1:], episodes.anatomy)


def _needed(network: CausalNetwork | None, role: str) -> CausalNetwork:
    if network is None:
        raise InputError(f"the run has no {role} network; train it with --network both")
    return network


def _driven(
    episodes: Dataset,
    length: Float[np.ndarray, "episodes samples"],
    turn: Float[np.ndarray, "episodes samples"],
    limits: DriveLimits,
) -> tuple[Steps2, Steps2]:
    """Return x^prox and control of a drive that is led along the last lengths and turns as far as it can follow."""
    control = np.empty((*length.shape, 2))
    last = episodes.valid.shape[1] - length.shape[1] - 1
    inserted = episodes.inserted_length[:, last].astype(float)
    for t in range(length.shape[1]):
        asked = np.column_stack([length[:, t] - inserted, turn[:, t]]) / SAMPLE_PERIOD_S
        control[:, t] = limits.clip(asked, inserted, SAMPLE_PERIOD_S)
        inserted = inserted + SAMPLE_PERIOD_S * control[:, t, 0]
    start = np.stack([episodes.inserted_length, episodes.rotation], axis=-1)[:, last : last + 1].astype(float)
    return start + SAMPLE_PERIOD_S * np.cumsum(control, axis=1), control


def _along(episodes: Dataset, proximal: Steps2, control: Steps2) -> Dataset:
    """Return episodes that are driven otherwise in their last samples."""

    def then(given: np.ndarray, later: np.ndarray) -> np.ndarray:
        return np.concatenate([given[:, : -later.shape[1]], later.astype(given.dtype)], axis=1)

    return replace(
        episodes,
        control=then(episodes.control, control),
        inserted_length=then(episodes.inserted_length, proximal[..., 0]),
        rotation=then(episodes.rotation, proximal[..., 1]),
    )
