"""The causal networks: from the vessel, the whole past and simulated wires they predict the tip.

FF predicts (Δtip, γtip) from the drive's motion, IF the drive's motion from the desired tip. Inputs at every sample are
the vessel around the tip, the push–pull envelopes, the play operator between them (`play`), and what was observed a
sample ago; FF also gets wires of different friction that are simulated under the same controls (`simulated_wires`). A
recurrent layer carries the past:

    inputs -> two dense layers -> GRU -> two dense layers -> for each guess: weight, location and scale b

Each guess, of the play operator and of every simulated wire, is one component of a mixture of Laplace distributions.
Where the wires part, at a snap or at a branching point, the mixture has several modes: the tip may be at either. FF
also gives the probability that the tip jumps in the sample.

The loss is the negative logarithm of the mixture's density plus the expected absolute error in units of its mean over
the training data, so that rare snaps, which the density forgives, count as well, and the cross entropy of the jumps.
Nothing feeds back: the network is run once over all controls, and the output at a sample depends on nothing that comes
after it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from weakref import WeakKeyDictionary

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from endopilot.devices.drive_limits import DriveLimits
from endopilot.models.config import WINDOW, CausalConfig
from endopilot.models.episodes import (
    EachObserved,
    Episodes,
    EpisodeSetUp,
    Observed,
    OpenLoop,
    Prediction,
    Steps2,
    begin_after,
    given_states,
    needed,
)
from endopilot.models.play import Direction, PlayTables
from endopilot.models.sequences import N_INPUTS, N_WIRE_INPUTS, Unfolded, play_tables, unfold
from endopilot.models.simulated_wires import FRICTION_FACTORS, SimulatedWires
from endopilot.types import SAMPLE_PERIOD_S

_GIVEN_WEIGHT = 0.3
"""Weight of the loss over the first 30 samples, where the tip was observed a sample ago."""
_LEAST_SCALE = 0.02
"""Smallest scale of a component, in units of the mean absolute change."""
_RARE = -5.0
"""Logit of the probability of a jump in an untrained network: jumps are rare."""
_BISECTIONS = 40
_FARTHEST = 6.0
"""Inputs are clipped to this many standard deviations, so that an unusual vessel cannot lead the network far astray."""
_REFINEMENTS = 2
"""Times that P3 corrects the controls by the tip that FF predicts from them."""


class CausalNetwork(nn.Module):
    """What FF and IF have in common.

    Buffers `input_mean`, `input_scale` and `output_scale` are part of the checkpoint; `fit_scales` sets them.
    """

    n_inputs: int
    n_guesses: int

    def __init__(self, config: CausalConfig):
        super().__init__()
        width = config.width
        self.embedding = nn.Sequential(
            nn.Linear(self.n_inputs, width), nn.GELU(), nn.Dropout(config.drop_share), nn.Linear(width, width)
        )
        self.memory = nn.GRU(width, width, config.layers, batch_first=True)
        self.head = nn.Sequential(
            nn.LayerNorm(2 * width), nn.Linear(2 * width, width), nn.GELU(), nn.Dropout(config.drop_share)
        )
        self.output = nn.Linear(width, 5 * self.n_guesses + 1)
        nn.init.zeros_(self.output.weight)  # an untrained network believes all guesses alike
        nn.init.zeros_(self.output.bias)
        self.register_buffer("input_mean", torch.zeros(self.n_inputs))
        self.register_buffer("input_scale", torch.ones(self.n_inputs))
        self.register_buffer("output_scale", torch.ones(2))

    input_mean: Tensor
    input_scale: Tensor
    output_scale: Tensor

    def forward(
        self, inputs: Float[Tensor, "b samples inputs"], others: Float[Tensor, "b samples wires 2"]
    ) -> Float[Tensor, "b samples outputs"]:
        """Return the mixture, as `Mixture.of` takes it: log weights, locations and scales of both changes, and jumps.

        Args:
            others: by how much the guesses after the first differ from it.
        """
        scaled = ((inputs - self.input_mean) / self.input_scale).clamp(-_FARTHEST, _FARTHEST)
        tokens = self.embedding(scaled)
        carried, _ = self.memory(tokens)
        out = self.output(self.head(torch.cat([carried, tokens], dim=-1)))
        n, each = self.n_guesses, (*out.shape[:-1], self.n_guesses, 2)
        centers = torch.cat([torch.zeros_like(out[..., None, :2]), others], dim=-2)
        location = centers + out[..., n : 3 * n].view(each) * self.output_scale
        scale = (F.softplus(out[..., 3 * n : 5 * n].view(each)) + _LEAST_SCALE) * self.output_scale
        weight = torch.log_softmax(out[..., :n], dim=-1)
        return torch.cat([weight, location.flatten(-2), scale.flatten(-2), out[..., -1:] + _RARE], dim=-1)

    def fit_scales(
        self,
        inputs: Float[Tensor, "b samples inputs"],
        others: Float[Tensor, "b samples wires 2"],
        change: Float[Tensor, "b samples 3"],
    ) -> None:
        """Set the scales from training data."""
        flat = inputs.flatten(0, 1)
        self.input_mean.copy_(flat.mean(dim=0))
        self.input_scale.copy_(flat.std(dim=0).clamp(min=1e-3))
        self.output_scale.copy_(change[:, WINDOW:, :2].abs().mean(dim=(0, 1)).clamp(min=1e-6))

    def loss(
        self, output: Float[Tensor, "b samples outputs"], change: Float[Tensor, "b samples 3"]
    ) -> Float[Tensor, ""]:
        """Return −log density of the mixture, plus the expected absolute error, plus the cross entropy of the jumps."""
        found = Mixture.of(output, self.n_guesses)
        error = (found.location - change[..., None, :2]).abs()
        density = (-error / found.scale - (found.scale / self.output_scale).log()).sum(dim=-1)
        likely = -torch.logsumexp(found.log_weight + density, dim=-1)
        absolute = (found.log_weight.exp() * (error / self.output_scale).sum(dim=-1)).sum(dim=-1)
        jump = F.binary_cross_entropy_with_logits(found.jump, change[..., 2], reduction="none")
        weight = torch.ones(change.shape[1], device=change.device)
        weight[:WINDOW] = _GIVEN_WEIGHT
        return (weight * (0.5 * (likely + absolute) + jump)).mean()


class CausalForward(CausalNetwork):
    """FF: guesses of the play operator and of the simulated wires."""

    n_inputs = N_INPUTS + N_WIRE_INPUTS
    n_guesses = 1 + len(FRICTION_FACTORS)


class CausalInverse(CausalNetwork):
    """IF: the play operator's guess alone."""

    n_inputs = N_INPUTS
    n_guesses = 1


CAUSAL_NETWORKS: dict[str, type[CausalNetwork]] = {"ff": CausalForward, "if": CausalInverse}


@dataclass(frozen=True, eq=False)
class Mixture:
    """A mixture of Laplace distributions of two independent quantities, and the probability of a jump.

    Attributes:
        log_weight: logarithm of each component's weight.
        location: median of each component.
        scale: its scale b.
        jump: logit of the probability that the tip jumps in the sample.
    """

    log_weight: Float[Tensor, "b samples n"]
    location: Float[Tensor, "b samples n 2"]
    scale: Float[Tensor, "b samples n 2"]
    jump: Float[Tensor, "b samples"]

    @staticmethod
    def of(output: Float[Tensor, "b samples outputs"], n: int) -> Mixture:
        """Return the mixture of n components that a network's output says."""
        each = (*output.shape[:-1], n, 2)
        location, scale = (output[..., first * n : (first + 2) * n].view(each) for first in (1, 3))
        return Mixture(output[..., :n], location, scale, output[..., -1])

    def median(self) -> Float[Tensor, "b samples 2"]:
        """Return the median of both quantities, which lies between the components' medians, by bisection."""
        weight = self.log_weight.exp()[..., None]
        low, high = self.location.amin(dim=-2), self.location.amax(dim=-2)
        for _ in range(_BISECTIONS):
            middle = 0.5 * (low + high)
            away = (middle[..., None, :] - self.location) / self.scale
            tail = 0.5 * torch.exp(-away.abs())
            below = (weight * torch.where(away < 0, tail, 1 - tail)).sum(dim=-2) < 0.5
            low, high = torch.where(below, middle, low), torch.where(below, high, middle)
        return 0.5 * (low + high)

    def deviation(self, center: Float[Tensor, "b samples 2"]) -> Float[Tensor, "b samples 2"]:
        """Return the root mean square distance from a center."""
        away = self.location - center[..., None, :]
        return (self.log_weight.exp()[..., None] * (2 * self.scale**2 + away**2)).sum(dim=-2).sqrt()


@dataclass(frozen=True, eq=False)
class CausalPredictor:
    """The pair of causal networks.

    Attributes:
        forward: FF, if it was trained.
        inverse: IF, if it was trained.
        prepared: names and tables of the patients of each setup that it has predicted in.
    """

    forward: CausalNetwork | None
    inverse: CausalNetwork | None
    limits: DriveLimits
    prepared: WeakKeyDictionary[EpisodeSetUp, tuple[tuple[str, ...], PlayTables]] = field(
        default_factory=WeakKeyDictionary, repr=False
    )
    wires: SimulatedWires = field(default_factory=SimulatedWires, repr=False)

    def predict(self, episodes: Episodes, observed: Observed | EachObserved) -> Prediction:
        """Predict the tips of episodes from their controls and from the observed tips: see `ProbabilisticPredictor`."""
        network = needed(self.forward, "forward")
        given = np.broadcast_to(observed, episodes.branch.shape)
        unfolded, found = self._run(network, "forward", episodes, given)
        median = found.median()
        tip = np.where(given[..., None], episodes.tip.astype(float), unfolded.guess + median.double().numpy())
        spread = np.where(given[..., None], 0.0, found.deviation(median).double().numpy())
        weight = found.log_weight[..., 1:].exp().double().numpy()
        jump = np.maximum(found.jump.sigmoid().double().numpy(), (weight * unfolded.jumping).sum(axis=-1))
        return Prediction(tip, spread, jump)

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
        network = needed(self.inverse, "inverse")
        given = np.broadcast_to(np.arange(episodes.samples) < begin, episodes.branch.shape)
        unfolded, found = self._run(network, "inverse", episodes, given)
        wanted = (unfolded.guess + found.location[..., 0, :].double().numpy())[:, begin:]
        return wanted[..., 0], wanted[..., 1]

    @torch.inference_mode()
    def _run(
        self,
        network: CausalNetwork,
        direction: Direction,
        episodes: Episodes,
        observed: Bool[np.ndarray, "episodes samples"],
    ) -> tuple[Unfolded, Mixture]:
        """Return the guesses for episodes, and the distribution of the change against the play operator's."""
        vessels, patient = self._vessels(episodes)
        wires = self.wires.tips(episodes, observed) if direction == "forward" else None
        unfolded = unfold(direction, vessels, patient, episodes, observed, wires)
        inputs, others = (torch.as_tensor(part, dtype=torch.float32) for part in (unfolded.inputs, unfolded.others))
        return unfolded, Mixture.of(network(inputs, others), network.n_guesses)

    def _vessels(self, episodes: Episodes) -> tuple[PlayTables, Int[np.ndarray, "episodes"]]:
        """Return the tables of the episodes' patients, perhaps of others too, and which row each episode has."""
        names, vessels = self.prepared.get(episodes.setup, ((), None))
        if vessels is None or not set(episodes.anatomy.tolist()) <= set(names):
            names, vessels = tuple(np.unique(episodes.anatomy).tolist()), play_tables(episodes)
            self.prepared[episodes.setup] = names, vessels
        return vessels, np.searchsorted(names, episodes.anatomy)


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
