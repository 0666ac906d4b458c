"""Measure what was tried for the causal model, and write the table of it into docs/evidence/learning.md.

`python docs/figures/learning_tried.py FOLDER`: FOLDER holds the dataset that the page's commands make. Every network is
trained for a minute or two on one core, and measured on patients that it was not trained on.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from learning import PAGE, row, written
from torch import Tensor

from endopilot.dataset.loader import Dataset, read_dataset
from endopilot.evaluation.protocols import hold_slack
from endopilot.models import play
from endopilot.models.causal import CausalForward, CausalInverse, CausalNetwork, Mixture
from endopilot.models.config import WINDOW, CausalConfig
from endopilot.models.episodes import Episodes
from endopilot.models.sequences import N_INPUTS, N_WIRE_INPUTS, Sequences, play_tables, unfold
from endopilot.models.simulated_wires import FRICTION_FACTORS, read_or_simulate

PATIENTS, EPOCHS, BATCH, RATE = 60, 3, 32, 2e-3
ENVELOPES = np.r_[2:8, 11:27]
"""Columns that come from the envelopes or the play operator."""
VESSEL = np.arange(play.N_FEATURES - 4 * len(play.WINDOW_MM) - 3, play.N_FEATURES)
SEEN = np.arange(play.N_FEATURES, N_INPUTS)
VARIANTS: dict[str, np.ndarray] = {
    "all": np.array([], dtype=int),
    "without the vessel's geometry": VESSEL,
    "without envelopes and play among the inputs": ENVELOPES,
    "without the observation a sample ago": SEEN,
}
"""Inputs that a network does not get, by the name of the row."""


class WithoutWires(CausalInverse):
    """A forward network that knows no simulated wire: its only guess is the play operator's."""

    def forward(self, inputs: Tensor, others: Tensor) -> Tensor:
        """Return the mixture of one component."""
        return super().forward(inputs[..., :N_INPUTS], others[..., :0, :])

    def fit_scales(self, inputs: Tensor, others: Tensor, change: Tensor) -> None:
        """Set the scales from training data."""
        super().fit_scales(inputs[..., :N_INPUTS], others[..., :0, :], change)


def guess_rows(data: Dataset) -> Iterator[str]:
    """Yield what is predicted without learning: slack held, play operator, simulated wires."""
    episodes = Episodes.of_dataset(data)
    vessels, patient = play_tables(episodes), np.unique(data.anatomy, return_inverse=True)[1]
    observed = np.broadcast_to(np.arange(data.valid.shape[1]) < WINDOW, data.valid.shape)
    truth = np.stack([data.tip_abscissa, data.tip_offset], axis=-1)[:, :, 0].astype(float)
    held = np.abs(hold_slack(data, WINDOW) - truth[:, WINDOW:])
    yield row("hold slack and offset", np.pad(held, ((0, 0), (WINDOW, 0), (0, 0))))
    guess = unfold("forward", vessels, patient, episodes, observed).guess
    yield row("play operator, nothing learned", np.abs(guess - truth))
    middle = FRICTION_FACTORS.index(1.0)
    for name, seen in (
        ("simulated wire as it is given, nothing learned", np.zeros_like(observed)),
        ("simulated wire fitted to the given states, nothing learned", observed),
    ):
        wire = read_or_simulate(episodes.setup.patients_folder, episodes, seen).tip[:, :, middle]
        yield row(name, np.abs(np.where(np.isfinite(wire), wire, guess) - truth))


def _sequences(data: Dataset) -> Sequences:
    episodes = Episodes.of_dataset(data)
    return Sequences.of(episodes, play_tables(episodes), ("ff",), 0)


def variant_rows(training: Dataset, held_out: Dataset) -> Iterator[str]:
    """Yield what short trainings reach, each without some of the inputs, another size or fewer data."""
    names = np.random.default_rng(0).permutation(np.unique(training.anatomy))
    test = _sequences(held_out)
    made = _sequences(training[np.isin(training.anatomy, names[:PATIENTS])])
    for name, hidden in VARIANTS.items():
        yield row(f"network: {name}", _trained(made, test, hidden=hidden))
    yield row("network: without the simulated wires", _trained(made, test, WithoutWires))
    yield row("network: half as wide", _trained(made, test, width=48))
    yield row("network: no mirror images, as many steps", _trained(made, test, forms=2))
    made = _sequences(training[np.isin(training.anatomy, names[: PATIENTS // 3])])
    yield row("network: a third of the patients, as many steps", _trained(made, test, longer=3))


def _trained(
    made: Sequences,
    test: Sequences,
    network_of: type[CausalNetwork] = CausalForward,
    *,
    width: int = CausalConfig.width,
    hidden: np.ndarray = VARIANTS["all"],
    forms: int = 4,
    longer: int = 1,
) -> np.ndarray:
    """Return the errors on held-out patients after a short training.

    Args:
        made: to train on.
        test: to measure with.
        network_of: what is trained.
        width: of the network.
        hidden: inputs that it does not get.
        forms: of every sequence to train on; the first two are no mirror images.
        longer: times that the training is longer.
    """
    torch.manual_seed(0)
    network = network_of(CausalConfig(width=width))
    keep = torch.ones(N_INPUTS + N_WIRE_INPUTS)
    keep[hidden] = 0.0
    network.fit_scales(made.inputs["ff"][:, 0] * keep, made.others["ff"][:, 0], made.change["ff"][:, 0])
    optimizer, targets = torch.optim.Adam(network.parameters()), made.targets()
    steps = longer * EPOCHS * (len(targets) // BATCH)
    targets = targets[targets[:, 1] < forms]
    for step in range(steps):
        if step % (len(targets) // BATCH) == 0:
            order = torch.randperm(len(targets))
        at = step % (len(targets) // BATCH)
        inputs, others, change = made.window("ff", targets[order[at * BATCH : (at + 1) * BATCH]])
        loss = network.loss(network(inputs * keep, others), change)
        optimizer.param_groups[0]["lr"] = RATE * min(1, (step + 1) / 50) * 0.5 * (1 + math.cos(math.pi * step / steps))
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimizer.step()
    with torch.inference_mode():
        found = network.eval()(test.inputs["ff"][:, 0] * keep, test.others["ff"][:, 0])
        median = Mixture.of(found, network.n_guesses).median()
    return (median - test.change["ff"][:, 0, :, :2]).abs().numpy()


if __name__ == "__main__":
    torch.set_num_threads(1)
    data = read_dataset(Path(sys.argv[1]) / "dataset")
    held_out = data.of_split("calibrate")
    rows = [*guess_rows(held_out), *variant_rows(data.of_split("train"), held_out)]
    PAGE.write_text(written(PAGE.read_text(encoding="utf-8"), "tried", rows), encoding="utf-8")
