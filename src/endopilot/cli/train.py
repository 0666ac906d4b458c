"""`endopilot train`: dataset -> forward and inverse networks."""

from __future__ import annotations

import os

from tyro.conf import Positional

from endopilot.cli.arguments import Answer, Existing, OutputFolder
from endopilot.files import read_json
from endopilot.models.config import TrainConfig


def command(
    dataset: Positional[tuple[Existing, ...]], /, *, output: OutputFolder, config: TrainConfig = TrainConfig()
) -> Answer | None:
    """Train the paper's forward and inverse network on a dataset.

    An interrupted run goes on where it stopped when the same command is given again.

    Args:
        dataset: folders made by `endopilot dataset`, or the folder `episode` that `endopilot navigate` leaves; several,
            of one wire and with episodes of one length, are trained on together.
        output: folder of the run.
    """
    from endopilot.models.train import train  # torch takes seconds to import; --help must not wait for it

    train(dataset, output=output, config=config)
    if os.environ.get("RANK", "0") != "0":  # torchrun runs several processes; one of them prints
        return None
    training = read_json(output / "training.json")
    ends = {name.upper(): {"epochs": len(of["curve"])} | of["curve"][-1] for name, of in training.items()}
    shown = ("epochs", "loss", "validation_loss", "samples_per_second")
    figures = {name: {key: end[key] for key in shown} for name, end in ends.items()}
    return Answer({"run": output, "training": training}, [{"run": output} | figures])
