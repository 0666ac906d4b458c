"""The processes that train together, as `torchrun` starts them, and the processor that each of them computes on.

Data parallel: every process takes its share of each batch, gradients are averaged (`DistributedDataParallel`), and the
first process alone writes. Without `torchrun` the group has one process, and nothing differs from plain training.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta

import torch
from torch import Tensor, distributed, nn
from torch.nn.parallel import DistributedDataParallel

from endopilot.errors import InputError
from endopilot.models.config import Processor
from endopilot.progress import silence

_PATIENCE = timedelta(hours=12)
"""How long the others wait while the first process reads the dataset."""


@dataclass(frozen=True)
class ProcessGroup:
    """The processes that train together, from the point of view of one of them.

    Attributes:
        rank: index of this process; 0 writes.
        size: number of processes.
        device: processor that this one computes on.
    """

    rank: int
    size: int
    device: torch.device

    @property
    def writes(self) -> bool:
        """Whether this process writes files."""
        return self.rank == 0

    def together(self, network: nn.Module) -> nn.Module:
        """Return a network whose gradients are the means over all processes."""
        return network if self.size == 1 else DistributedDataParallel(network)

    def share(self, batch: Tensor) -> Tensor:
        """Return this process's part of a batch."""
        return batch[self.rank :: self.size]

    def mean(self, value: Tensor, part: int, whole: int) -> float:
        """Return the mean over a batch of `whole` samples from the means over parts, this one's of `part` samples."""
        if self.size == 1:
            return value.item()
        total = value.detach() * (part / whole)
        distributed.all_reduce(total)
        return total.item()

    def agreed(self, number: int) -> int:
        """Return the number that the first process has."""
        if self.size == 1:
            return number
        shared = torch.tensor(number, device=self.device)
        distributed.broadcast(shared, 0)
        return int(shared)

    @contextmanager
    def first(self) -> Iterator[None]:
        """Let the first process go through a block before the others."""
        if self.size > 1 and not self.writes:
            distributed.barrier()
        yield
        if self.size > 1 and self.writes:
            distributed.barrier()


@contextmanager
def joined(processor: Processor) -> Iterator[ProcessGroup]:
    """Join the processes that `torchrun` started beside this one, if it did.

    Args:
        processor: what to compute on; "auto" takes a GPU where there is one.

    Raises:
        InputError: a GPU is required and there is none, or more processes than GPUs were started.
    """
    gpus = torch.cuda.device_count()
    if processor == "cuda" and not gpus:
        raise InputError("processor: cuda, but torch finds no GPU here; give cpu, or install torch for CUDA")
    on_gpu = gpus > 0 and processor != "cpu"
    if not distributed.is_torchelastic_launched() or int(os.environ["WORLD_SIZE"]) == 1:
        yield ProcessGroup(0, 1, torch.device("cuda" if on_gpu else "cpu"))
        return
    local = int(os.environ["LOCAL_RANK"])
    if on_gpu and local >= gpus:
        raise InputError(f"processor: {gpus} GPUs for more processes; give torchrun --nproc-per-node {gpus}")
    device = torch.device("cuda", local) if on_gpu else torch.device("cpu")
    if on_gpu:
        torch.cuda.set_device(device)
    distributed.init_process_group("nccl" if on_gpu else "gloo", timeout=_PATIENCE)
    try:
        group = ProcessGroup(distributed.get_rank(), distributed.get_world_size(), device)
        if not group.writes:
            silence()
        yield group
    finally:
        distributed.destroy_process_group()
