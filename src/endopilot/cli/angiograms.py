"""`endopilot angiograms`: anatomies or CTs -> cines with the truth beside each frame."""

from __future__ import annotations

from tyro.conf import Positional

from endopilot.angiograms.config import AngiogramsConfig
from endopilot.cli.arguments import Existing, Figures, OutputFolder
from endopilot.devices.stack import Stack
from endopilot.files import read_json


def angiograms_command(
    patients: Positional[tuple[Existing, ...]],
    /,
    *,
    output: OutputFolder,
    device: str = "workhorse-014",
    catheter: tuple[str, ...] = (),
    scheduler: str | None = None,
    config: AngiogramsConfig = AngiogramsConfig(),
) -> Figures:
    """Make X-ray cines of patients' vessels, with contrast, motion and devices, and the truth of each frame.

    An interrupted run goes on where it stopped when the same command is given again.

    Args:
        patients: folders made by `endopilot anatomy` or `endopilot atlas`, or CT angiograms, which are segmented.
        output: folder of the data set.
    """
    from endopilot.angiograms.config import MANIFEST_FILE, SAMPLES_FILE  # slow to import; --help needs none
    from endopilot.angiograms.make import make_angiograms

    make_angiograms(patients, output=output, device=Stack.of(device, *catheter), config=config, scheduler=scheduler)
    splits = read_json(output / MANIFEST_FILE)["splits"]
    return {
        "data_set": output,
        **{f"{split}_{what}": count for split, counts in splits.items() for what, count in counts.items()},
        "samples": output / SAMPLES_FILE,
    }
