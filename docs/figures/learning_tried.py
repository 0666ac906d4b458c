"""Measure what was tried for the causal model, and write the table of it into docs/learning.md.

`python docs/figures/learning_tried.py FOLDER [VARIED]`: FOLDER holds the dataset that the page's commands make, VARIED
is a dataset of wires whose friction and stiffness vary, as docs/xray.md makes it; without it its rows are left out.
Every network is trained for a minute or two on one core, and measured on patients that it was not trained on.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from learning import PAGE, row, written
from torch import Tensor, nn

from endopilot.dataset.loader import Dataset, load_dataset
from endopilot.evaluation.prediction_baselines import hold_slack
from endopilot.models import causal, play
from endopilot.models.causal import CausalNetwork
from endopilot.models.config import WINDOW, CausalConfig
from endopilot.models.episodes import Episodes
from endopilot.models.sequences import N_INPUTS, Sequences, prepare_vessels, unfold

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
Make = Callable[[CausalConfig], CausalNetwork]


class Attention(nn.Module):
    """Attention to all earlier samples, in two layers of four heads, in place of the recurrent layer."""

    def __init__(self, width: int):
        super().__init__()
        layer = nn.TransformerEncoderLayer(width, 4, 2 * width, 0.1, F.gelu, batch_first=True)
        self.layers = nn.TransformerEncoder(layer, 2)
        self.place = nn.Parameter(0.02 * torch.randn(1000, width))

    def forward(self, tokens: Tensor) -> tuple[Tensor, None]:
        """Return what is carried to every sample, as a recurrent layer does, and no state."""
        samples = tokens.shape[1]
        mask = nn.Transformer.generate_square_subsequent_mask(samples)
        return self.layers(tokens + self.place[:samples], mask=mask, is_causal=True), None


class Decoder(CausalNetwork):
    """A causal decoder."""

    def __init__(self, config: CausalConfig):
        super().__init__(config)
        self.memory = Attention(config.width)


class Blunt(CausalNetwork):
    """The absolute error alone is the loss: the network does not say how sure it is."""

    def loss(self, answer: Tensor, change: Tensor) -> Tensor:
        """Return the absolute error in units of its mean over the training data."""
        weight = torch.ones(change.shape[1], 1)
        weight[:WINDOW] = causal._GIVEN_WEIGHT
        return (weight * (answer[..., :2] - change).abs() / self.output_scale).mean()


def play_rows(data: Dataset) -> Iterator[str]:
    """Yield what the play operator does alone, as it is and with variations."""
    episodes = Episodes.of_dataset(data)
    vessels, patient = prepare_vessels(episodes), np.unique(data.anatomy, return_inverse=True)[1]
    observed = np.broadcast_to(np.arange(data.valid.shape[1]) < WINDOW, data.valid.shape)
    truth = np.stack([data.tip_abscissa, data.tip_offset], axis=-1).astype(float)
    held = np.abs(hold_slack(data, WINDOW) - truth[:, WINDOW:])
    yield row("hold slack and offset", np.pad(held, ((0, 0), (WINDOW, 0), (0, 0))))

    def guessed(episodes: Episodes) -> np.ndarray:
        return np.abs(unfold("forward", vessels, patient, episodes, observed).guess - truth)

    yield row("play operator, nothing learned", guessed(episodes))
    yield row(
        "play operator, the tip's rotation lags by up to 0.003 rad a mm",
        guessed(replace(episodes, proximal=np.stack([data.inserted_length, _lagging(data)], axis=-1))),
    )
    before = play._SHARPNESS
    for sharpness in (4.0, 80.0):
        play._SHARPNESS = sharpness
        yield row(f"play operator, nominal wires mixed with a concentration of {sharpness:g}", guessed(episodes))
    play._SHARPNESS = before


def _lagging(data: Dataset) -> np.ndarray:
    """Return the rotation of a tip that follows the drive's with a play that grows with the inserted length, rad."""
    angle, out = data.initial_rotation.astype(float), np.empty(data.rotation.shape)
    for t in range(out.shape[1]):
        room = 0.003 * data.inserted_length[:, t]
        angle = np.clip(angle, data.rotation[:, t] - room, data.rotation[:, t] + room)
        out[:, t] = angle
    return out


def _sequences(data: Dataset) -> Sequences:
    episodes = Episodes.of_dataset(data)
    return Sequences.of(episodes, prepare_vessels(episodes), ("ff",), 0)


def variant_rows(training: Dataset, held_out: Dataset) -> Iterator[str]:
    """Yield what short trainings reach, each without some of the inputs, another size or other data."""
    names = np.unique(training.anatomy)
    few = training.select(np.isin(training.anatomy, names[:PATIENTS]))
    fewer = training.select(np.isin(training.anatomy, names[: PATIENTS // 3]))
    test = _sequences(held_out)
    made = _sequences(few)
    for name, hidden in VARIANTS.items():
        yield row(f"network: {name}", _trained(made, test, hidden=hidden))
    yield row("network: half as wide", _trained(made, test, width=48))
    yield row("network: no mirror images, as many steps", _trained(made, test, forms=2))
    yield row("network: absolute error alone, no spread", _trained(made, test, Blunt))
    yield row("network: causal decoder of two layers in place of the GRU", _trained(made, test, Decoder))
    made = _sequences(fewer)
    yield row("network: a third of the patients, as many steps", _trained(made, test, longer=3))


def varied_rows(data: Dataset) -> Iterator[str]:
    """Yield what it is worth to know the wire, where its friction and the stiffness of its tip vary."""
    training, test = data.select(np.isin(data.split, ("train", "calibrate"))), data.of_split("test")
    truth = np.stack([test.tip_abscissa, test.tip_offset], axis=-1)[:, WINDOW:].astype(float)
    held = np.abs(hold_slack(test, WINDOW) - truth)
    yield row("varied wires: hold slack and offset", np.pad(held, ((0, 0), (WINDOW, 0), (0, 0))))
    known, unknown = (_sequences(part) for part in (training, test))
    yield row("varied wires: network: all", _trained(known, unknown))
    for part, made in ((training, known), (test, unknown)):
        wire = np.stack([part.friction, part.tip_stiffness_factor], axis=-1)
        made.inputs["ff"][..., SEEN[:2]] = torch.as_tensor(wire, dtype=torch.float32)[:, None, None]
    yield row("varied wires: network: given friction and stiffness", _trained(known, unknown))


def _trained(
    made: Sequences,
    test: Sequences,
    network_of: Make = CausalNetwork,
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
    keep = torch.ones(N_INPUTS)
    keep[hidden] = 0.0
    network.fit_scales(made.inputs["ff"][:, 0] * keep, made.change["ff"][:, 0])
    optimizer, targets = torch.optim.Adam(network.parameters()), made.targets()
    steps = longer * EPOCHS * (len(targets) // BATCH)
    targets = targets[targets[:, 1] < forms]
    for step in range(steps):
        if step % (len(targets) // BATCH) == 0:
            order = torch.randperm(len(targets))
        at = step % (len(targets) // BATCH)
        inputs, change = made.window("ff", targets[order[at * BATCH : (at + 1) * BATCH]])
        loss = network.loss(network(inputs * keep), change)
        optimizer.param_groups[0]["lr"] = RATE * min(1, (step + 1) / 50) * 0.5 * (1 + math.cos(math.pi * step / steps))
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimizer.step()
    with torch.inference_mode():
        answer = network.eval()(test.inputs["ff"][:, 0] * keep)
    return (answer[..., :2] - test.change["ff"][:, 0]).abs().numpy()


if __name__ == "__main__":
    torch.set_num_threads(1)
    data = load_dataset(Path(sys.argv[1]) / "dataset")
    held_out = data.of_split("calibrate")
    rows = [*play_rows(held_out), *variant_rows(data.of_split("train"), held_out)]
    if len(sys.argv) > 2:
        rows += varied_rows(load_dataset(Path(sys.argv[2])))
    PAGE.write_text(written(PAGE.read_text(encoding="utf-8"), "tried", rows), encoding="utf-8")
