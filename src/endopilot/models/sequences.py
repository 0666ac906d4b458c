"""Whole navigations as the causal networks take them: features of every sample, and what is to be predicted there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from endopilot.models import play
from endopilot.models.config import WINDOW
from endopilot.models.episodes import Episodes
from endopilot.models.play import PARTIAL_PLAYS, Direction, Vessels
from endopilot.progress import progress

N_INPUTS = play.N_FEATURES + 4
"""Inputs of a network at a sample: the features, and four numbers of what was observed."""
_OBSERVED_SHARE = 0.05
"""In training, share of the later samples at which the tip is observed too, in one of two copies of each sequence."""


@dataclass(frozen=True, eq=False)
class Unfolded:
    """Episodes with the play operator applied along them.

    Attributes:
        inputs: of the network.
        guess: forward: (Δtip, γtip) of play and envelopes, mm; inverse: Δ by the play (mm) and a turn of 0 (rad).
        branch: branch that the play operator puts the tip in.
        truth: forward: (Δtip, γtip), mm; inverse: Δ (mm) and the turn over the sample (rad).
    """

    inputs: Float[np.ndarray, "episodes samples inputs"]
    guess: Float[np.ndarray, "episodes samples 2"]
    branch: Int[np.ndarray, "episodes samples"]
    truth: Float[np.ndarray, "episodes samples 2"]


def prepare_vessels(episodes: Episodes) -> Vessels:
    """Return the tables of the episodes' patients, in the order of their names; those not yet prepared are prepared.

    Raises:
        InputError: an anatomy is missing, damaged or cannot be prepared.
    """
    names = np.unique(episodes.anatomy).tolist()
    patients = []
    with progress("Patients", total=len(names)) as advance:
        for name in names:
            patients.append(episodes.setup.patient(name))
            advance(1, name)
    return Vessels.of(patients, episodes.setup.device)


def unfold(
    direction: Direction,
    vessels: Vessels,
    patient: Int[np.ndarray, "episodes"],
    episodes: Episodes,
    observed: Bool[np.ndarray, "episodes samples"],
) -> Unfolded:
    """Apply the play operator along episodes, and correct it after every sample at which the state was observed.

    Sample t depends on nothing later: forward, on the motion up to t and the tips observed before it; inverse, on the
    desired tips up to t and the motion before it, where observed.
    """
    (tip, offset), (inserted, rotation) = (
        np.moveaxis(signal.astype(float), -1, 0) for signal in (episodes.tip, episodes.proximal)
    )
    forward = direction == "forward"
    initial_length, initial_angle = episodes.initial.astype(float).T
    state = vessels.start(patient, initial_length, initial_angle)
    if not forward:
        state = replace(state, partial=np.repeat(state.inserted[:, None], len(PARTIAL_PLAYS), axis=1))
    inputs = np.zeros((*tip.shape, N_INPUTS), dtype=np.float32)
    guess, branches = np.zeros((*tip.shape, 2)), np.zeros(tip.shape, dtype=np.int64)
    angle, turn = initial_angle, np.zeros(len(tip))
    for t in range(tip.shape[1]):
        if forward:
            turn, angle = rotation[:, t] - angle, rotation[:, t]
        else:
            inputs[:, t, -2:] = np.stack([offset[:, t], offset[:, t] - offset[:, max(t - 1, 0)]], axis=-1)
        known = inserted[:, t] if forward else tip[:, t]
        state, features, off_axis = vessels.step(direction, patient, state, known, angle, turn)
        inputs[:, t, : play.N_FEATURES] = features
        branches[:, t] = state.branch
        guess[:, t, 0] = state.tip if forward else state.inserted
        if forward:
            guess[:, t, 1] = off_axis
        now = observed[:, t]
        wanted = tip[:, t] if forward else inserted[:, t]
        if t + 1 < tip.shape[1]:
            inputs[:, t + 1, play.N_FEATURES] = now
            inputs[:, t + 1, play.N_FEATURES + 1] = np.where(now, wanted - guess[:, t, 0], 0.0)
            if forward:
                lateral = np.stack([offset[:, t], offset[:, t] - guess[:, t, 1]], axis=-1)
                inputs[:, t + 1, play.N_FEATURES + 2 :] = np.where(now[:, None], lateral, 0.0)
        branch = np.where(now, episodes.branch[:, t], state.branch)
        if forward:
            state = replace(state, tip=np.where(now, wanted, state.tip), branch=branch)
        else:
            state = replace(state, inserted=np.where(now, wanted, state.inserted), branch=branch)
            turn, angle = np.where(now, rotation[:, t] - angle, 0.0), np.where(now, rotation[:, t], angle)
    turned = np.diff(rotation, axis=1, prepend=initial_angle[:, None])
    truth = np.stack([tip, offset] if forward else [inserted, turned], axis=-1)
    return Unfolded(inputs, guess, branches, truth)


@dataclass(frozen=True, eq=False)
class Sequences:
    """Sequences to train on, each in four forms: with the first 30 states observed or others at random, and mirrored.

    Attributes:
        tip: (Δtip, γtip), mm; for counting.
        inputs: of the networks, by network: (sequences, 2 forms, samples, inputs).
        change: truth minus guess, by network.
    """

    tip: Float[Tensor, "episodes samples 2"]
    inputs: dict[str, Float[Tensor, "episodes forms samples inputs"]]
    change: dict[str, Float[Tensor, "episodes forms samples 2"]]

    @staticmethod
    def of(episodes: Episodes, vessels: Vessels, networks: Sequence[str], seed: int) -> Sequences:
        """Return the sequences of some episodes.

        Args:
            episodes: the navigations, with their true tips.
            vessels: tables of their patients, as `prepare_vessels` gives them.
            networks: "ff", "if" or both.
            seed: of the samples at which tips are observed.
        """
        patient = np.unique(episodes.anatomy, return_inverse=True)[1]
        shape = episodes.branch.shape
        given = np.broadcast_to(np.arange(shape[1]) < WINDOW, shape)
        generator = np.random.default_rng([seed, shape[0]])
        first = generator.integers(1, 2 * WINDOW, shape[0])
        some = (np.arange(shape[1]) < first[:, None]) | (generator.random(shape) < _OBSERVED_SHARE)
        inputs, change = {}, {}
        for network in networks:
            direction: Direction = "forward" if network == "ff" else "inverse"
            forms = [unfold(direction, vessels, patient, episodes, observed) for observed in (given, some)]
            inputs[network] = torch.stack([torch.as_tensor(form.inputs) for form in forms], dim=1)
            rest = [torch.as_tensor(form.truth - form.guess, dtype=torch.float32) for form in forms]
            change[network] = torch.stack(rest, dim=1)
        return Sequences(torch.as_tensor(episodes.tip, dtype=torch.float32), inputs, change)

    def targets(self) -> Int[Tensor, "forms 2"]:
        """Return (sequence, form) of every form of every sequence."""
        return torch.cartesian_prod(torch.arange(len(self.tip)), torch.arange(4))

    def window(self, network: str, target: Int[Tensor, "b 2"]) -> tuple[Tensor, Tensor]:
        """Return the network's inputs of some forms, and by how much the truth differs from the guess."""
        sequence, form = target[:, 0], target[:, 1]
        inputs, change = self.inputs[network][sequence, form % 2], self.change[network][sequence, form % 2]
        mirrored = (form >= 2)[:, None, None]  # and the others by 1: one product is cheaper than a choice of two
        sign = torch.as_tensor(np.append(play.mirrored(), np.ones(N_INPUTS - play.N_FEATURES)), dtype=torch.float32)
        turned = torch.tensor([1.0, 1.0 if network == "ff" else -1.0])
        inputs *= torch.where(mirrored, sign, 1.0)  # of the copies that indexing made
        change *= torch.where(mirrored, turned, 1.0)
        return inputs, change
