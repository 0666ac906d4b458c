"""Learning curves for TensorBoard: `tensorboard --logdir RUN`."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

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
