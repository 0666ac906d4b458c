"""Training of the paper's FF and IF on a dataset: `train`.

Adam warms up for half an epoch and decays along a cosine; gradients are clipped to norm 1. After every epoch one file,
`checkpoints/<network>.safetensors`, is written whole or not at all; it holds weights, optimizer and learning curve, and
a killed run goes on from it along the same curve. All randomness follows from the seed and the epoch, so on one machine
a run with a fixed number of steps repeats to the bit.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from endopilot.dataset.loader import read_joined
from endopilot.errors import InputError
from endopilot.files import manifest, write_json
from endopilot.models.checkpoint import (
    optimizer_tensors,
    read_tensors,
    restore_optimizer,
    write_network,
    write_tensors,
)
from endopilot.models.config import TrainConfig
from endopilot.models.episodes import Episodes
from endopilot.models.paper import NETWORKS, Network, Windows
from endopilot.progress import Advance, progress
from endopilot.runs import claim

VALIDATION_WINDOWS = 512
"""Windows of held-out navigations that the loss is checked on after every epoch."""
WARM_UP_EPOCHS = 0.5
"""Epochs over which the learning rate rises to its peak; afterwards it falls to zero along a cosine."""
_SCALE_WINDOWS = 16384
_GRADIENT_NORM = 1.0


def train(dataset: str | Path | Sequence[str | Path], *, output: str | Path, config: TrainConfig | None = None) -> None:
    """Train the forward and the inverse network on the split "train" and write them into a run folder.

    Writes `ff.safetensors` and `if.safetensors` (weights and scales), `training.json` (learning curves) and
    `manifest.json`. A run that was interrupted goes on where it stopped when it is started again with the
    same arguments; a finished one returns at once.

    Args:
        dataset: folder of a dataset made by `endopilot dataset`, or several that are trained on together.
        output: run folder.
        config: what is trained, and how long; as the paper has it if not given.

    Raises:
        InputError: the dataset cannot be used, the run folder belongs to another run, the processor is not there, or
            the loss left the finite numbers (the last good checkpoint stays).
    """
    config, run = config or TrainConfig(), Path(output)
    if config.processor == "cuda" and not torch.cuda.is_available():
        raise InputError("processor: cuda, but torch finds no GPU here; give cpu, or install torch for CUDA")
    folders = [Path(each) for each in ([dataset] if isinstance(dataset, str | Path) else dataset)]
    data = read_joined(folders)
    claim(run, "endopilot train", config=config, dataset=data.manifest["key"])
    training, validation = Windows.of(Episodes.of_dataset(data.of_split("train"))), None
    if "seen_test" in data.split:
        validation = Windows.of(Episodes.of_dataset(data.of_split("seen_test")))
    start, results = time.perf_counter(), {}
    for name in config.networks:
        network, results[name] = Job(name, config, training, validation, run).run()
        write_network(run / f"{name}.safetensors", name, network, config.size)
        write_json(run / "training.json", results)
    record = manifest(
        config=config,
        seed=config.seed,
        inputs={"dataset": data.manifest["key"]},
        dataset=os.path.relpath(folders[0].resolve(), run.resolve()),
        joined=[os.path.relpath(folder.resolve(), run.resolve()) for folder in folders[1:]],
        patients=sorted(data.patients[name] for name in set(data.of_split("train").anatomy.tolist())),
        episodes={"train": len(training.tip), "seen_test": 0 if validation is None else len(validation.tip)},
        rejected={"invalid_episodes": int((~data.valid.all(axis=1)).sum())},
        device=data.manifest["device"],
        simulator=data.manifest["config"]["simulator"],
        networks={name: {key: result[key] for key in result if key != "curve"} for name, result in results.items()},
        threads=torch.get_num_threads(),
        wall_seconds=time.perf_counter() - start,
    )
    write_json(run / "manifest.json", record)


@dataclass(frozen=True, eq=False)
class Job:
    """The training of one network.

    Attributes:
        name: of the network, "ff" or "if".
        config: how long it is trained, and on what.
        training: what it learns from.
        validation: what its loss is checked on, if anything.
        run_folder: of the checkpoint.
    """

    name: str
    config: TrainConfig
    training: Windows
    validation: Windows | None
    run_folder: Path

    def run(self) -> tuple[Network, dict[str, Any]]:
        """Train, or go on training, until the last epoch; return the network and its learning curve."""
        config = self.config
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(_seed(config.seed, self.name, "weights"))
            network = NETWORKS[self.name](config.size)
            targets = self.training.targets()
            chosen = torch.linspace(0, len(targets) - 1, min(len(targets), _SCALE_WINDOWS)).long()
            network.fit_scales(*self.training.window(self.name, targets[chosen]))
            network.to(self._device)
            optimizer = torch.optim.Adam(network.parameters(), lr=config.learning_rate, fused=True)
            state = self._resume(network, optimizer) or {"seconds": 0.0, "curve": []}
            with progress(f"Training {self.name.upper()}", total=config.epochs) as advance:
                advance(len(state["curve"]))
                while len(state["curve"]) < config.epochs:
                    self._epoch(network, optimizer, state, advance)
                    tensors = {f"network.{key}": value for key, value in network.state_dict().items()}
                    tensors |= optimizer_tensors(optimizer)
                    write_tensors(self._checkpoint, tensors, {"network": self.name, **state})
        return network.eval(), {"parameters": sum(p.numel() for p in network.parameters())} | state

    def _epoch(self, network: Network, optimizer: torch.optim.Adam, state: dict[str, Any], advance: Advance) -> None:
        """Go through one epoch, check the loss on held-out navigations, and add both to the state's curve."""
        config, epoch, start = self.config, len(state["curve"]), time.perf_counter()
        batches, allowed_s = self.batches(epoch), math.inf
        if config.max_seconds is not None:  # an epoch has its share of what is left
            allowed_s = max((config.max_seconds - state["seconds"]) / (config.epochs - epoch), 1e-3)
        torch.manual_seed(_seed(config.seed, self.name, epoch))
        network.train()
        losses, rate, samples, first = [], 0.0, 0, time.perf_counter()
        for step, targets in enumerate(batches):
            share = max(step / len(batches), (time.perf_counter() - first) / allowed_s)
            if step and share >= 1:
                break
            rate = config.learning_rate * _schedule(epoch + min(share, 1.0), config.epochs)
            losses.append(self.step(network, optimizer, targets, rate))
            if not math.isfinite(losses[-1]):
                episodes = sorted(set(targets[:, 0].tolist()))[:8]
                raise InputError(
                    f"{self.run_folder}: the loss of {self.name} became {losses[-1]} in epoch {epoch + 1}, batch "
                    f"{step + 1} (train episodes {episodes} and others); the checkpoint of epoch {epoch} is kept; "
                    "look for bad samples in the dataset or lower learning_rate"
                )
            samples += len(targets)
            speed = samples / (time.perf_counter() - first)
            advance(1 / len(batches), f"loss {np.mean(losses):.3f}, {speed:.0f} samples/s")
        seconds, loss = time.perf_counter() - first, float(np.mean(losses))
        entry = {"epoch": epoch + 1, "steps": len(losses), "loss": loss, "validation_loss": self._validate(network)}
        entry |= {"learning_rate": rate, "samples_per_second": samples / seconds, "seconds": seconds}
        state["curve"].append(entry)
        state["seconds"] += time.perf_counter() - start

    def step(self, network: Network, optimizer: torch.optim.Adam, targets: Tensor, rate: float) -> float:
        """Take one step along the gradient and return the loss before it; a loss that is not finite takes no step."""
        *window, truth = self._window(self.training, targets)
        with torch.autocast(self._device, torch.bfloat16, enabled=self.config.precision == "bfloat16"):
            answer = network(*window)
        loss = network.loss(answer.float(), truth)
        if math.isfinite(value := loss.item()):
            optimizer.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(network.parameters(), _GRADIENT_NORM)
            optimizer.param_groups[0]["lr"] = rate
            optimizer.step()
        return value

    @torch.no_grad()
    def _validate(self, network: Network) -> float | None:
        if self.validation is None:
            return None
        network.eval()
        targets = self.validation.targets()
        chosen = torch.linspace(0, len(targets) - 1, min(len(targets), VALIDATION_WINDOWS)).long()
        *window, truth = self._window(self.validation, targets[chosen])
        return network.loss(network(*window), truth).item()

    def batches(self, epoch: int) -> Sequence[Tensor]:
        """Return the targets of every batch of an epoch: all windows in random order, or the first of them."""
        steps = math.ceil((self.config.windows_per_epoch or 2**62) / self.config.batch_size)
        targets = self.training.targets()
        generator = torch.Generator().manual_seed(_seed(self.config.seed, self.name, "order", epoch))
        order = torch.randperm(len(targets), generator=generator)
        return targets[order].split(self.config.batch_size)[:steps]

    def _window(self, examples: Windows, targets: Tensor) -> list[Tensor]:
        return [part.to(self._device) for part in examples.window(self.name, targets)]

    def _resume(self, network: Network, optimizer: torch.optim.Adam) -> dict[str, Any] | None:
        if not self._checkpoint.exists():
            return None
        tensors, facts = read_tensors(self._checkpoint)
        weights = {key.removeprefix("network."): t for key, t in tensors.items() if key.startswith("network.")}
        network.load_state_dict(weights)
        restore_optimizer(optimizer, tensors)
        return {key: facts[key] for key in ("seconds", "curve")}

    @property
    def _device(self) -> str:
        return "cuda" if self.config.processor != "cpu" and torch.cuda.is_available() else "cpu"

    @property
    def _checkpoint(self) -> Path:
        return self.run_folder / "checkpoints" / f"{self.name}.safetensors"


def _schedule(epoch: float, epochs: int) -> float:
    """Return the learning rate's share of its peak: a linear rise, then half a cosine down to zero."""
    warm_up = min(WARM_UP_EPOCHS, epochs / 10)
    if epoch < warm_up:
        return (epoch + 0.01) / (warm_up + 0.01)
    return 0.5 * (1 + math.cos(math.pi * (epoch - warm_up) / (epochs - warm_up)))


def _seed(*parts: int | str) -> int:
    """Return a 63-bit seed for one purpose, so that streams of different purposes never meet."""
    words = [part if isinstance(part, int) else int.from_bytes(part.encode(), "little") for part in parts]
    return int(np.random.SeedSequence(words).generate_state(1, np.uint64)[0] >> 1)
