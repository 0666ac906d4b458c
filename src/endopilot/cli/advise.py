"""`endopilot advise`: trained run -> when X-ray is needed."""

from __future__ import annotations

from pathlib import Path

from tyro.conf import Positional

from endopilot.cli.arguments import OutputFolder, existing, show
from endopilot.xray.advise import FIGURES_FILE, PICTURE_FILE, advise
from endopilot.xray.monitoring import AdviseConfig


def command(
    run: Positional[Path],
    dataset: Positional[Path],
    /,
    *,
    output: OutputFolder,
    json: bool = False,
    config: AdviseConfig = AdviseConfig(),
) -> None:
    """Calibrate the X-ray adviser of a run, and measure what it misses on patients not seen.

    Args:
        run: folder made by `endopilot train`, which takes the calibration, xray.json; or `pretrained`, the model that
            comes with endopilot, whose calibration goes to the output.
        dataset: folder made by `endopilot dataset`, with at least 9 patients in its split 'calibrate'.
        output: folder of advice.json and advice.png.
        json: print the figures as JSON.
        config: what X-ray must not miss, and how it errs.
    """
    found = advise(run, existing(dataset), output, config)
    if json:
        show(found, as_json=True)
        return
    at, cover = found["adviser"], found["coverage"]
    show(
        {
            "figures": str(output / FIGURES_FILE),
            "picture": str(output / PICTURE_FILE),
            "level": found["calibration"].level,
            "coverage": cover["simultaneous"],
            "coverage_of_worst_decile_of_patients": cover["worst_decile_of_patients"],
            "missed_share": at["missed_share"],
            "exposures_per_minute": at["exposures_per_minute"],
            "share_of_the_exposures_of_periodic_imaging": found["share_of_the_exposures_of_periodic_imaging"],
            "fewer_frames_than_fluoroscopy": at["fewer_frames_than_fluoroscopy"],
        },
        as_json=False,
    )
