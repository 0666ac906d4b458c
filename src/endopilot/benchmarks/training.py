"""Training speed beside a plain PyTorch loop over the same model and data: `bench_training`."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn
from torch.utils.data import DataLoader, TensorDataset

from endopilot import __version__
from endopilot.anatomy.io import write_anatomy
from endopilot.atlas.atlas import AtlasConfig, make_patient
from endopilot.dataset.config import DatasetConfig
from endopilot.dataset.generate import generate_dataset
from endopilot.dataset.loader import load_dataset
from endopilot.devices.device import read_device
from endopilot.models.checkpoint import make_network
from endopilot.models.config import TrainConfig
from endopilot.models.process_group import ProcessGroup
from endopilot.models.train import AnyNetwork, Examples, Job, examples_of
from endopilot.runs import claim

STEPS = 20
"""Steps of each loop in one round."""
ROUNDS = 7
"""Rounds in which both loops take turns; the median ratio is reported, since the speed of a machine varies."""
_SEQUENCES = 48


def bench_training(folder: Path) -> list[dict[str, Any]]:
    """Train the paper's and the causal forward network for some steps by `train` and by a plain loop, on one thread.

    The plain loop is that of a tutorial: a shuffled `DataLoader` over a `TensorDataset`, Adam, backward, the same
    clipping of gradients. Processor time is measured, not wall time.

    Args:
        folder: gets one synthetic patient and its navigations, which take some seconds to make.

    Returns:
        One row a model: samples a second of each loop, and the median over the rounds of their ratio, with its bar.
    """
    claim(folder, "endopilot bench training", version=__version__)
    patient = folder / "patient"
    if not patient.exists():
        write_anatomy(make_patient(AtlasConfig(), 0), patient)
    generate_dataset(
        [patient], folder / "dataset", read_device("workhorse-014"), DatasetConfig(sequences=_SEQUENCES, seconds=60.0)
    )
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        return [
            compare_with_plain_loop(
                folder / "dataset", TrainConfig(model=model, network="ff", processor="cpu"), model, rounds=ROUNDS
            )
            for model in ("paper", "causal")
        ]
    finally:
        torch.set_num_threads(threads)


def compare_with_plain_loop(dataset: Path, config: TrainConfig, name: str, *, rounds: int) -> dict[str, Any]:
    """Return the row of one model: both loops by turns on the split "train" of a dataset."""
    examples = examples_of(load_dataset(dataset), "train", config)
    targets = examples.targets()
    *window, truth = examples.window("ff", targets)
    loader = DataLoader(TensorDataset(*window, truth), config.batch_size, shuffle=True)
    ours, plain = [], []
    for _ in range(rounds):
        ours.append(_by_train(examples, config))
        plain.append(_by_a_plain_loop(loader, examples, config))
    ratio = float(np.median(np.array(ours) / np.array(plain)))
    return {
        "model": name,
        "samples_per_second": round(float(np.median(ours)), 1),
        "plain_samples_per_second": round(float(np.median(plain)), 1),
        "ratio": round(ratio, 3),
        "bar": 1.0,
        "passed": ratio >= 1.0,
    }


def _begun(examples: Examples, config: TrainConfig) -> AnyNetwork:
    network = make_network("ff", config.network_size)
    network.fit_scales(*examples.window("ff", examples.targets()[:256]))
    return network.train()


def _by_train(examples: Examples, config: TrainConfig) -> float:
    """Return the samples that `train` takes in a second of processor time."""
    job = Job("ff", config, examples, None, Path(), ProcessGroup(0, 1, torch.device("cpu")))
    network = _begun(examples, config)
    optimizer = torch.optim.Adam(network.parameters(), config.learning_rate, fused=True)
    batches = job.batches(0, STEPS)
    start = time.process_time()
    for targets in batches:
        job.step(network, network, optimizer, targets, config.learning_rate)
    return sum(map(len, batches)) / (time.process_time() - start)


def _by_a_plain_loop(loader: DataLoader, examples: Examples, config: TrainConfig) -> float:
    """Return the samples that a plain loop takes in a second of processor time."""
    network = _begun(examples, config)
    optimizer = torch.optim.Adam(network.parameters(), config.learning_rate)
    taken, start = 0, time.process_time()
    for _, (*window, truth) in zip(range(STEPS), loader, strict=False):
        optimizer.zero_grad()
        loss = network.loss(network(*window), truth)
        loss.backward()
        nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimizer.step()
        loss.item()  # what is shown
        taken += len(truth)
    return taken / (time.process_time() - start)
