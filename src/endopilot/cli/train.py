"""`endopilot train`: dataset -> forward and inverse networks."""

from __future__ import annotations

import os
from pathlib import Path

from tyro.conf import Positional

from endopilot.cli.arguments import OutputFolder, existing, show
from endopilot.files import read_json
from endopilot.models.config import TrainConfig


def command(
    dataset: Positional[tuple[Path, ...]],
    /,
    *,
    output: OutputFolder,
    json: bool = False,
    config: TrainConfig = TrainConfig(),
) -> None:
    """Train the forward and the inverse network on a dataset.

    An interrupted run goes on where it stopped when the same command is given again.

    Args:
        dataset: folders made by `endopilot dataset`, or the folder `episode` that `endopilot navigate` leaves; several,
            of one wire and with episodes of one length, are trained on together.
        output: folder of the run.
        json: print the figures as JSON.
        config: model and training.
    """
    from endopilot.models.train import train  # torch takes seconds to import; --help must not wait for it

    train([existing(folder) for folder in dataset], output, config)
    if os.environ.get("RANK", "0") != "0":  # torchrun runs several processes; one of them prints
        return
    training = read_json(output / "training.json")
    if json:
        show({"run": str(output), "training": training}, as_json=True)
        return
    ends = {name.upper(): {"epochs": len(of["curve"])} | of["curve"][-1] for name, of in training.items()}
    shown = ("epochs", "loss", "validation_loss", "samples_per_second")
    show({"run": str(output)} | {name: {key: end[key] for key in shown} for name, end in ends.items()}, as_json=False)
