"""Whole navigations as the causal networks see them: features of every sample, and what is to be predicted there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from endopilot.anatomy.io import read_anatomy
from endopilot.dataset.loader import Dataset
from endopilot.models import play
from endopilot.models.config import WINDOW
from endopilot.models.patient import prepared
from endopilot.models.play import PARTIAL_PLAYS, Direction, Vessels
from endopilot.progress import progress
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.device import Device

PATIENTS_FOLDER = "patients"
"""Folder beside the samples of a dataset in which its patients are kept as they were prepared for its device."""
N_INPUTS = play.N_FEATURES + 4
"""Numbers that a network is told of a sample: the features, and four of what was seen."""
_SEEN_SHARE = 0.05
"""In training, share of the later samples at which the tip is seen too, in one of two copies of each sequence."""


@dataclass(frozen=True, eq=False)
class Unfolded:
    """Episodes with the play operator led along them.

    Attributes:
        inputs: what the network is told.
        guess: forward: (Δtip, γtip) of play and envelopes, mm; inverse: Δ by the play (mm) and a turn of 0 (rad).
        branch: branch that the tip is believed to be in.
        truth: forward: (Δtip, γtip), mm; inverse: Δ (mm) and the turn over the sample (rad).
    """

    inputs: Float[np.ndarray, "episodes samples inputs"]
    guess: Float[np.ndarray, "episodes samples 2"]
    branch: Int[np.ndarray, "episodes samples"]
    truth: Float[np.ndarray, "episodes samples 2"]


def read_vessels(episodes: Dataset) -> Vessels:
    """Return the tables of a dataset's patients in the order of their names; who was not prepared is prepared now."""
    device = Device.from_record(episodes.manifest["device"])
    config = SimulatorConfig(**episodes.manifest["config"]["simulator"])
    fingerprints = {record["name"]: record["sha256"] for record in episodes.manifest["anatomies"]}
    names = np.unique(episodes.anatomy).tolist()
    patients, kept = [], episodes.folder / PATIENTS_FOLDER
    with progress("Patients", total=len(names)) as advance:
        for name in names:
            folder = episodes.anatomy_folder(name)
            patients.append(prepared(kept, name, fingerprints[name], device, config, partial(read_anatomy, folder)))
            advance(1, name)
    return Vessels.of(patients, device)


def unfold(
    direction: Direction,
    vessels: Vessels,
    patient: Int[np.ndarray, "episodes"],
    episodes: Dataset,
    seen: Bool[np.ndarray, "episodes samples"],
) -> Unfolded:
    """Lead the play operator along episodes, and put it right after every sample at which the state was seen.

    Nothing of sample t depends on what is known later: forward, that is the motion up to t and the tips seen before it;
    inverse, the desired tips up to t and the motion before it, where seen.
    """
    tip, offset, inserted, rotation = (
        getattr(episodes, name).astype(float) for name in ("tip_abscissa", "tip_offset", "inserted_length", "rotation")
    )
    forward = direction == "forward"
    state = vessels.start(
        patient, episodes.initial_inserted_length.astype(float), episodes.initial_rotation.astype(float)
    )
    if not forward:
        state = replace(state, partial=np.repeat(state.inserted[:, None], len(PARTIAL_PLAYS), axis=1))
    inputs = np.zeros((*tip.shape, N_INPUTS), dtype=np.float32)
    guess, believed = np.zeros((*tip.shape, 2)), np.zeros(tip.shape, dtype=np.int64)
    angle, turn = episodes.initial_rotation.astype(float), np.zeros(len(tip))
    for t in range(tip.shape[1]):
        if forward:
            turn, angle = rotation[:, t] - angle, rotation[:, t]
        else:
            inputs[:, t, -2:] = np.stack([offset[:, t], offset[:, t] - offset[:, max(t - 1, 0)]], axis=-1)
        known = inserted[:, t] if forward else tip[:, t]
        state, features, off_axis = vessels.step(direction, patient, state, known, angle, turn)
        inputs[:, t, : play.N_FEATURES] = features
        believed[:, t] = state.branch
        guess[:, t, 0] = state.tip if forward else state.inserted
        if forward:
            guess[:, t, 1] = off_axis
        now = seen[:, t]
        wanted = tip[:, t] if forward else inserted[:, t]
        if t + 1 < tip.shape[1]:
            inputs[:, t + 1, play.N_FEATURES] = now
            inputs[:, t + 1, play.N_FEATURES + 1] = np.where(now, wanted - guess[:, t, 0], 0.0)
            if forward:
                told = np.where(now[:, None], np.stack([offset[:, t], offset[:, t] - guess[:, t, 1]], axis=-1), 0.0)
                inputs[:, t + 1, play.N_FEATURES + 2 :] = told
        branch = np.where(now, episodes.branch[:, t], state.branch)
        if forward:
            state = replace(state, tip=np.where(now, wanted, state.tip), branch=branch)
        else:
            state = replace(state, inserted=np.where(now, wanted, state.inserted), branch=branch)
            turn, angle = np.where(now, rotation[:, t] - angle, 0.0), np.where(now, rotation[:, t], angle)
    turned = np.diff(rotation, axis=1, prepend=episodes.initial_rotation[:, None])
    truth = np.stack([tip, offset] if forward else [inserted, turned], axis=-1)
    return Unfolded(inputs, guess, believed, truth)


@dataclass(frozen=True, eq=False)
class Sequences:
    """Sequences to train on, each in four forms: with the first 30 states seen or with some at random, and mirrored.

    Attributes:
        tip: (Δtip, γtip), mm; for counting.
        inputs: what the networks are told, by network: (sequences, 2 forms, samples, inputs).
        change: truth minus guess, by network.
    """

    tip: Float[Tensor, "episodes samples 2"]
    inputs: dict[str, Float[Tensor, "episodes forms samples inputs"]]
    change: dict[str, Float[Tensor, "episodes forms samples 2"]]

    @staticmethod
    def of(dataset: Dataset, vessels: Vessels, networks: Sequence[str], seed: int) -> Sequences:
        """Return the episodes of a dataset.

        Args:
            dataset: the episodes.
            vessels: tables of their patients, as `read_vessels` gives them.
            networks: "ff", "if" or both.
            seed: of the samples at which tips are seen.
        """
        patient = np.unique(dataset.anatomy, return_inverse=True)[1]
        shape = dataset.valid.shape
        given = np.broadcast_to(np.arange(shape[1]) < WINDOW, shape)
        generator = np.random.default_rng([seed, shape[0]])
        first = generator.integers(1, 2 * WINDOW, shape[0])
        some = (np.arange(shape[1]) < first[:, None]) | (generator.random(shape) < _SEEN_SHARE)
        inputs, change = {}, {}
        for network in networks:
            direction: Direction = "forward" if network == "ff" else "inverse"
            forms = [unfold(direction, vessels, patient, dataset, seen) for seen in (given, some)]
            inputs[network] = torch.stack([torch.as_tensor(form.inputs) for form in forms], dim=1)
            rest = [torch.as_tensor(form.truth - form.guess, dtype=torch.float32) for form in forms]
            change[network] = torch.stack(rest, dim=1)
        tip = np.stack([dataset.tip_abscissa, dataset.tip_offset], axis=-1)
        return Sequences(torch.as_tensor(tip, dtype=torch.float32), inputs, change)

    def targets(self) -> Int[Tensor, "forms 2"]:
        """Return (sequence, form) of every form of every sequence."""
        return torch.cartesian_prod(torch.arange(len(self.tip)), torch.arange(4))

    def window(self, network: str, target: Int[Tensor, "b 2"]) -> tuple[Tensor, Tensor]:
        """Return what the network is told of some forms, and by how much the truth differs from the guess."""
        sequence, form = target[:, 0], target[:, 1]
        inputs, change = self.inputs[network][sequence, form % 2], self.change[network][sequence, form % 2]
        mirrored = (form >= 2)[:, None, None]  # and the others by 1: one product is cheaper than a choice of two
        sign = torch.as_tensor(np.append(play.mirrored(), np.ones(N_INPUTS - play.N_FEATURES)), dtype=torch.float32)
        turned = torch.tensor([1.0, 1.0 if network == "ff" else -1.0])
        inputs *= torch.where(mirrored, sign, 1.0)  # of the copies that indexing made
        change *= torch.where(mirrored, turned, 1.0)
        return inputs, change
