"""Training of the paper's FF and IF on a dataset: `train`.

After every epoch one file, `checkpoints/<network>.safetensors`, is written whole or not at all; it holds weights,
optimizer and learning curve, and a killed run goes on from it along the same curve. All randomness follows from the
seed and the epoch, so on one machine a run with a fixed number of steps repeats to the bit.
"""

from __future__ import annotations

import copy
import math
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from endopilot import __version__
from endopilot.dataset.loader import Dataset, read_joined
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
from endopilot.models.process_group import ProcessGroup, joined
from endopilot.models.transformer import NETWORKS, Network, Windows
from endopilot.progress import Advance, progress
from endopilot.runs import claim

SCALARS = ("loss", "validation_loss", "learning_rate", "samples_per_second")
"""What is shown of each epoch."""


@contextmanager
def tensorboard_writer(folder: Path | None) -> Iterator[Callable[[Mapping[str, Any]], None]]:
    """Yield a function that adds an epoch of a network's learning curve to its event files.

    If a killed training had already written an epoch, TensorBoard drops the old one and what followed it.

    Args:
        folder: of the event files, one for each time that training was begun; none is written if not given.
    """
    with ExitStack() as stack:
        writer = None

        def add(epoch: Mapping[str, Any]) -> None:
            nonlocal writer
            if folder is None:
                return
            step = epoch["epoch"]
            if writer is None:
                from torch.utils.tensorboard import SummaryWriter  # slow to import

                if any(folder.glob("events.*")):
                    time.sleep(1)  # TensorBoard reads files in order of their names, which hold whole seconds
                writer = stack.enter_context(SummaryWriter(str(folder), purge_step=step))
            for name in SCALARS:
                value = epoch[name]
                if value is not None:
                    writer.add_scalar(name, value, step)
            writer.flush()

        yield add


VALIDATION_WINDOWS = 512
"""Windows of held-out navigations that the loss is checked on after every epoch."""
WARM_UP_EPOCHS = 0.5
"""Epochs over which the learning rate rises to its peak; afterwards it falls to zero along a cosine."""
_SCALE_WINDOWS = 16384
_TIMED_STEPS = 12
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
        InputError: the dataset cannot be used, the run folder belongs to another run, or the loss left the
            finite numbers (the last good checkpoint stays).
    """
    config = config or TrainConfig()
    with joined(config.processor) as group:
        folders = [dataset] if isinstance(dataset, str | Path) else dataset
        _train([Path(folder) for folder in folders], Path(output), config, group)


def _train(folders: list[Path], run_folder: Path, config: TrainConfig, group: ProcessGroup) -> None:
    dataset = read_joined(folders)
    with group.first():  # which writes the settings
        if group.writes:
            identity = {"config": config, "dataset": dataset.manifest["key"], "version": __version__}
            claim(run_folder, "endopilot train", **identity)
        training = windows_of(dataset, "train")
        validation = windows_of(dataset, "seen_test") if "seen_test" in dataset.split else None
    start = time.perf_counter()
    results: dict[str, Any] = {}
    for name in config.networks:
        job = Job(name, config, training, validation, run_folder, group)
        results[name] = job.run()
        if group.writes:
            write_json(run_folder / "training.json", results)
    if not group.writes:
        return
    record = manifest(
        config=config,
        seed=config.seed,
        inputs={"dataset": dataset.manifest["key"]},
        dataset=os.path.relpath(folders[0].resolve(), run_folder.resolve()),
        joined=[os.path.relpath(folder.resolve(), run_folder.resolve()) for folder in folders[1:]],
        patients=sorted(dataset.patients[name] for name in set(dataset.of_split("train").anatomy.tolist())),
        episodes={"train": len(training.tip), "seen_test": 0 if validation is None else len(validation.tip)},
        rejected={"invalid_episodes": int((~dataset.valid.all(axis=1)).sum())},
        device=dataset.manifest["device"],
        simulator=dataset.manifest["config"]["simulator"],
        networks={name: {key: result[key] for key in result if key != "curve"} for name, result in results.items()},
        threads=torch.get_num_threads(),
        processes=group.size,
        processor=group.device.type,
        wall_seconds=time.perf_counter() - start,
    )
    write_json(run_folder / "manifest.json", record)


def windows_of(dataset: Dataset, split: str) -> Windows:
    """Return the episodes of a split, which must be finite: one bad sample would spoil the scales of all."""
    chosen = dataset.of_split(split)
    for name in ("tip_abscissa", "tip_offset", "inserted_length", "rotation", "control"):
        finite = np.isfinite(getattr(chosen, name)).reshape(len(chosen), -1).all(axis=1)
        if not finite.all():
            bad = int(np.argmin(finite))
            raise InputError(
                f"{dataset.folder}: {name} of {chosen.anatomy[bad]}, sequence {chosen.sequence[bad]}, is not finite "
                "though the episode is marked valid; make the dataset again"
            )
    return Windows.of(Episodes.of_dataset(chosen))


@dataclass(frozen=True, eq=False)
class Job:
    """The training of one network, by one process of a group."""

    name: str
    config: TrainConfig
    training: Windows
    validation: Windows | None
    run_folder: Path
    group: ProcessGroup

    def run(self) -> dict[str, Any]:
        """Train, or go on training, until the last epoch; return the learning curve and how the steps were planned."""
        config = self.config
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(_seed(config.seed, self.name, "weights"))
            network = NETWORKS[self.name](config.size)
            targets = self.training.targets()
            chosen = torch.linspace(0, len(targets) - 1, min(len(targets), _SCALE_WINDOWS)).long()
            network.fit_scales(*self.training.window(self.name, targets[chosen]))
            network.to(self.group.device)
            optimizer = torch.optim.Adam(network.parameters(), lr=config.learning_rate, fused=True)
            state = self._resume(network, optimizer) or {"seconds": 0.0, "curve": []}
            folder = self.run_folder / "tensorboard" / self.name if self.group.writes else None
            with (
                progress(f"Training {self.name.upper()}", total=config.epochs) as advance,
                tensorboard_writer(folder) as write,
            ):
                advance(len(state["curve"]))
                together = self.group.together(network)
                while len(state["curve"]) < config.epochs:
                    self._epoch(network, together, optimizer, state, advance)
                    write(state["curve"][-1])
                    if self.group.writes:
                        self._save(network, optimizer, state)
        return {"parameters": sum(p.numel() for p in network.parameters())} | state

    def _epoch(
        self,
        network: Network,
        together: nn.Module,
        optimizer: torch.optim.Adam,
        state: dict[str, Any],
        advance: Advance,
    ) -> None:
        """Go through one epoch, check the loss on held-out navigations, and add both to the state's curve.

        Args:
            together: the same, as all processes of the group run it.
            state: `seconds` and `curve` so far.
        """
        epoch, epochs, start = len(state["curve"]), self.config.epochs, time.perf_counter()
        batches = self.batches(epoch, self._steps(network, state))
        torch.manual_seed(_seed(self.config.seed, self.name, epoch, *([self.group.rank] if self.group.rank else [])))
        network.train()
        total, rate, steps, first = 0.0, 0.0, len(batches), time.perf_counter()
        for step, targets in enumerate(batches):
            rate = self.config.learning_rate * _schedule(epoch + step / steps, epochs)
            loss = self.step(network, together, optimizer, targets, rate)
            if not math.isfinite(loss):
                episodes = sorted(set(targets[:, 0].tolist()))[:8]
                raise InputError(
                    f"{self.run_folder}: the loss of {self.name} became {loss} in epoch {epoch + 1}, batch {step + 1} "
                    f"(train episodes {episodes} and others); the checkpoint of epoch {epoch} is kept; "
                    "look for bad samples in the dataset or lower learning_rate"
                )
            total += loss
            speed = (step + 1) * self.config.batch_size / (time.perf_counter() - first)
            advance(1 / steps, f"loss {total / (step + 1):.3f}, {speed:.0f} samples/s")
        seconds = time.perf_counter() - first
        validation_loss = self._validate(network)
        state["curve"].append(
            {
                "epoch": epoch + 1,
                "steps": steps,
                "loss": total / steps,
                "validation_loss": validation_loss,
                "learning_rate": rate,
                "samples_per_second": sum(map(len, batches)) / seconds,
                "seconds": seconds,
                "validation_seconds": time.perf_counter() - first - seconds,
            }
        )
        state["seconds"] += time.perf_counter() - start

    def step(
        self,
        network: Network,
        together: nn.Module,
        optimizer: torch.optim.Adam,
        targets: torch.Tensor,
        rate: float,
    ) -> float:
        """Take one step along the gradient and return the loss before it; a loss that is not finite takes no step."""
        group, ours = self.group, self.group.share(targets)
        *window, truth = self._window(self.training, ours)
        with torch.autocast(group.device.type, torch.bfloat16, enabled=self.config.precision == "bfloat16"):
            answer = together(*window)
        loss = network.loss(answer.float(), truth)
        value = group.mean(loss, len(ours), len(targets))
        if math.isfinite(value):
            optimizer.zero_grad()
            share = len(ours) * group.size / len(targets)  # the mean over the group is then that over the batch
            (loss * share).backward()
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

    def batches(self, epoch: int, steps: int) -> list[torch.Tensor]:
        """Return the targets of every batch of an epoch: all windows in random order, or the first of them.

        A last batch that is too small for each process to have a share is left out.
        """
        targets = self.training.targets()
        generator = torch.Generator().manual_seed(_seed(self.config.seed, self.name, "order", epoch))
        order = torch.randperm(len(targets), generator=generator)
        batches = targets[order].split(self.config.batch_size)[:steps]
        whole = [batch for batch in batches if len(batch) >= self.group.size]
        if not whole:
            raise InputError(f"batch_size: {len(batches[0])} samples for {self.group.size} processes; give more")
        return whole

    def _window(self, examples: Windows, targets: torch.Tensor) -> list[torch.Tensor]:
        return [part.to(self.group.device) for part in examples.window(self.name, targets)]

    def _steps(self, network: Network, state: dict[str, Any]) -> int:
        """Return the steps of the next epoch: every window once, or what `windows_per_epoch` or the time allow."""
        config = self.config
        windows = min(len(self.training.targets()), config.windows_per_epoch or 2**62)
        steps = math.ceil(windows / config.batch_size)
        if config.max_seconds is None:
            return steps
        curve = state["curve"]
        if curve:
            a_step = sum(entry["seconds"] for entry in curve) / sum(entry["steps"] for entry in curve)
            validation = curve[-1]["validation_seconds"]
        else:
            a_step, validation = self._time(network)
        seconds_left = (config.max_seconds - state["seconds"]) / (config.epochs - len(curve)) - validation
        return self.group.agreed(max(min(steps, int(seconds_left / a_step)), 1))

    def _time(self, network: Network) -> tuple[float, float]:
        """Return how long a training step and a validation take, s, tried out on a copy of the network."""
        trial = copy.deepcopy(network).train()
        optimizer = torch.optim.Adam(trial.parameters(), fused=True)
        targets = self.batches(0, 1)[0]
        times = []
        for _ in range(_TIMED_STEPS):
            start = time.perf_counter()
            self.step(trial, trial, optimizer, targets, 0.0)
            times.append(time.perf_counter() - start)
        start = time.perf_counter()
        self._validate(trial)
        return float(np.median(times)), time.perf_counter() - start

    def _save(self, network: Network, optimizer: torch.optim.Adam, state: dict[str, Any]) -> None:
        tensors = {f"network.{key}": value for key, value in network.state_dict().items()}
        write_tensors(self._checkpoint, tensors | optimizer_tensors(optimizer), {"network": self.name, **state})
        write_network(self._file, self.name, network, self.config.size)

    def _resume(self, network: Network, optimizer: torch.optim.Adam) -> dict[str, Any] | None:
        if not self._checkpoint.exists():
            return None
        tensors, facts = read_tensors(self._checkpoint)
        weights = {key.removeprefix("network."): t for key, t in tensors.items() if key.startswith("network.")}
        network.load_state_dict(weights)
        restore_optimizer(optimizer, tensors)
        # A kill between the two files of an epoch leaves the second one behind by an epoch.
        if self.group.writes:
            write_network(self._file, self.name, network, self.config.size)
        return {key: facts[key] for key in ("seconds", "curve")}

    @property
    def _file(self) -> Path:
        return self.run_folder / f"{self.name}.safetensors"

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
