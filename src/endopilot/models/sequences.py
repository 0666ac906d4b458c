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
from endopilot.models.episodes import Episodes, jumps
from endopilot.models.play import PARTIAL_PLAYS, Direction, PlayTables
from endopilot.models.simulated_wires import FRICTION_FACTORS, WireTips, read_or_simulate
from endopilot.progress import progress

N_INPUTS = play.N_FEATURES + 4
"""Inputs of a network at a sample: the features, and four numbers of what was observed."""
N_WIRE_INPUTS = 6 * len(FRICTION_FACTORS) + 1
"""Further inputs of the forward network: six for each simulated wire, and the time since the tip was observed."""
_FARTHEST_MM = 5.0
"""Differences between simulated wires and tips are cut off here, mm: beyond, a wire is lost."""
_OBSERVED_SHARE = 0.05
"""In training, share of the later samples at which the tip is observed too, in one of two copies of each sequence."""


@dataclass(frozen=True, eq=False)
class Unfolded:
    """Episodes with the play operator applied along them.

    Attributes:
        guess: forward: (Δtip, γtip) of play and envelopes, mm, displaced by the patient's motion; inverse: Δ by the
            play (mm) and a turn of 0 (rad).
        others: forward: by how much the simulated wires differ from that guess, mm; inverse: none.
        jumping: forward: whether each simulated wire jumps in the sample; inverse: none.
        branch: branch that the play operator puts the tip in.
        truth: forward: (Δtip, γtip), mm; inverse: Δ (mm) and the turn over the sample (rad).
        jump: whether the tip jumps in the sample, the patient's motion left aside.
    """

    inputs: Float[np.ndarray, "episodes samples inputs"]
    guess: Float[np.ndarray, "episodes samples 2"]
    others: Float[np.ndarray, "episodes samples wires 2"]
    jumping: Bool[np.ndarray, "episodes samples wires"]
    branch: Int[np.ndarray, "episodes samples"]
    truth: Float[np.ndarray, "episodes samples 2"]
    jump: Bool[np.ndarray, "episodes samples"]


def play_tables(episodes: Episodes) -> PlayTables:
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
    return PlayTables.of(patients, episodes.setup.device)


def unfold(
    direction: Direction,
    vessels: PlayTables,
    patient: Int[np.ndarray, "episodes"],
    episodes: Episodes,
    observed: Bool[np.ndarray, "episodes samples"],
    wires: WireTips | None = None,
) -> Unfolded:
    """Apply the play operator along episodes, and correct it after every sample at which the state was observed.

    Sample t depends on nothing later: forward, on the motion up to t and the tips observed before it; inverse, on the
    desired tips up to t and the motion before it, where observed.

    Args:
        wires: forward: what the simulated wires did. By how much the patient's motion displaces the tip is taken off
            all tips before, and added to the guess behind.
    """
    if wires is not None:
        episodes = replace(episodes, tip=episodes.tip - wires.moved)
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
    others, jumping, jump = np.zeros((*tip.shape, 0, 2)), np.zeros((*tip.shape, 0), dtype=bool), jumps(tip, inserted)
    if wires is not None:
        others, columns = _beside(wires.tip - wires.moved[:, :, None], guess, inserted, episodes.tip, observed)
        inputs = np.concatenate([inputs, columns], axis=-1, dtype=np.float32)
        guess, truth = guess + wires.moved, truth + wires.moved
        jumping = np.stack([jumps(wire, inserted) for wire in np.moveaxis(wires.tip[..., 0], 2, 0)], axis=-1)
    return Unfolded(inputs, guess, others, jumping, branches, truth, jump)


def _beside(
    wires: Float[np.ndarray, "episodes samples wires 2"],
    guess: Float[np.ndarray, "episodes samples 2"],
    inserted: Float[np.ndarray, "episodes samples"],
    tip: Float[np.ndarray, "episodes samples 2"],
    observed: Bool[np.ndarray, "episodes samples"],
) -> tuple[Float[np.ndarray, "episodes samples wires 2"], Float[np.ndarray, "episodes samples inputs"]]:
    """Return by how much the simulated wires differ from a guess, mm, and what a network is given of them.

    For each wire: that difference, cut off; by how much the tip differed from it when it was last observed; the
    logarithm of its mean error so far; and how much more than the drive it moves in the sample. A wire whose simulation
    failed is where the guess is.
    """
    others = np.where(np.isfinite(wires), wires - guess[:, :, None], 0.0)
    at = guess[:, :, None] + others
    seen, missed = observed[:, :, None], np.where(observed[:, :, None, None], tip[:, :, None] - at, 0.0)
    missed = np.clip(missed, -_FARTHEST_MM, _FARTHEST_MM)
    index = np.where(observed, np.arange(observed.shape[1]), -1)
    before = np.pad(np.maximum.accumulate(index, axis=1), ((0, 0), (1, 0)), constant_values=-1)[:, :-1]
    last = np.take_along_axis(missed, np.maximum(before, 0)[:, :, None, None], axis=1) * (before >= 0)[:, :, None, None]
    count = np.pad(np.cumsum(seen, axis=1), ((0, 0), (1, 0), (0, 0)))[:, :-1]
    total = np.pad(np.cumsum(np.abs(missed[..., 0]), axis=1), ((0, 0), (1, 0), (0, 0)))[:, :-1]
    slack = inserted[:, :, None] - at[..., 0]
    columns = [
        *np.moveaxis(np.clip(others, -_FARTHEST_MM, _FARTHEST_MM), -1, 0),
        *np.moveaxis(last, -1, 0),
        np.log(total / np.maximum(count, 1) + 0.01),
        np.clip(np.diff(slack, axis=1, prepend=slack[:, :1]), -_FARTHEST_MM, _FARTHEST_MM),
    ]
    since = np.log1p(np.arange(observed.shape[1]) - before)
    return others, np.concatenate([*columns, since[:, :, None]], axis=-1)


@dataclass(frozen=True, eq=False)
class Sequences:
    """Sequences to train on, each in four forms: with the first 30 states observed or others at random, and mirrored.

    Attributes:
        tip: (Δtip, γtip), mm; for counting.
        inputs: of the networks, by network: (sequences, 2 forms, samples, inputs).
        others: by how much other guesses differ from the play operator's, by network.
        change: truth minus the play operator's guess, and 1 where the tip jumps, by network.
    """

    tip: Float[Tensor, "episodes samples 2"]
    inputs: dict[str, Float[Tensor, "episodes forms samples inputs"]]
    others: dict[str, Float[Tensor, "episodes forms samples wires 2"]]
    change: dict[str, Float[Tensor, "episodes forms samples 3"]]

    @staticmethod
    def of(episodes: Episodes, vessels: PlayTables, networks: Sequence[str], seed: int) -> Sequences:
        """Return the sequences of some episodes."""
        patient = np.unique(episodes.anatomy, return_inverse=True)[1]
        shape = episodes.branch.shape
        given = np.broadcast_to(np.arange(shape[1]) < WINDOW, shape)
        generator = np.random.default_rng([seed, shape[0]])
        first = generator.integers(1, 2 * WINDOW, shape[0])
        some = (np.arange(shape[1]) < first[:, None]) | (generator.random(shape) < _OBSERVED_SHARE)
        inputs, others, change = {}, {}, {}
        for network in networks:
            direction: Direction = "forward" if network == "ff" else "inverse"
            wires = (None, None)
            if network == "ff":  # of both forms at once: where all given states are observed they are the same
                twice = episodes.select(np.tile(np.arange(shape[0]), 2))
                wires = read_or_simulate(episodes.setup.patients_folder, twice, np.concatenate([given, some])).halves()
            forms = [
                unfold(direction, vessels, patient, episodes, observed, of_form)
                for observed, of_form in zip((given, some), wires, strict=True)
            ]
            rest = [np.concatenate([form.truth - form.guess, form.jump[..., None]], axis=-1) for form in forms]
            for kept, parts in (
                (inputs, [form.inputs for form in forms]),
                (others, [form.others for form in forms]),
                (change, rest),
            ):
                kept[network] = torch.as_tensor(np.stack(parts, axis=1), dtype=torch.float32)
        return Sequences(torch.as_tensor(episodes.tip, dtype=torch.float32), inputs, others, change)

    def targets(self) -> Int[Tensor, "forms 2"]:
        """Return (sequence, form) of every form of every sequence."""
        return torch.cartesian_prod(torch.arange(len(self.tip)), torch.arange(4))

    def window(self, network: str, target: Int[Tensor, "b 2"]) -> tuple[Tensor, Tensor, Tensor]:
        """Return a network's inputs of some forms, the other guesses, and the truth's difference from the first."""
        sequence, form = target[:, 0], target[:, 1]
        inputs, others, change = (kept[network][sequence, form % 2] for kept in (self.inputs, self.others, self.change))
        mirrored = (form >= 2)[:, None, None]  # and the others by 1: one product is cheaper than a choice of two
        ones = np.ones(inputs.shape[-1] - play.N_FEATURES)
        sign = torch.as_tensor(np.append(play.mirrored(), ones), dtype=torch.float32)
        turned = torch.tensor([1.0, 1.0 if network == "ff" else -1.0, 1.0])
        inputs *= torch.where(mirrored, sign, 1.0)  # indexing made copies, which may be changed
        change *= torch.where(mirrored, turned, 1.0)
        return inputs, others, change
