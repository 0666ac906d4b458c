"""`endopilot advise`: trained run -> when X-ray is needed."""

from __future__ import annotations

from pathlib import Path

from endopilot.belief.advise import FIGURES_FILE, PICTURE_FILE, advise
from endopilot.belief.monitoring import AdviseConfig
from endopilot.cli.arguments import Answer
from endopilot.runs import Existing, OutputFolder


def advise_command(
    run: Path,
    dataset: Existing,
    /,
    *,
    output: OutputFolder,
    also_test: tuple[Existing, ...] = (),
    config: AdviseConfig = AdviseConfig(),
) -> Answer:
    """Calibrate the X-ray adviser of a run, and measure on unseen patients which events it misses.

    The adviser asks for X-ray before the tip may be at the wall or far from where the model predicts it.

    Args:
        run: folder made by `endopilot train`; the calibration, xray.json, is written into it. Or `wires`,
            the simulated wires; the calibration is then written to the output.
        dataset: folder made by `endopilot dataset`, with at least 9 patients in its split 'calibrate'.
        output: folder of advice.json and advice.png.
        also_test: datasets that were made otherwise, with another wall or other elements: the same calibration is
            measured on their test patients too, which the bands must not have been fitted to.
    """
    found = advise(run, dataset, output, config, also_test=also_test)
    at, cover, left_out = found["adviser"], found["coverage"], found["patients_not_registered"]
    shown = {
        "figures": str(output / FIGURES_FILE),
        "picture": str(output / PICTURE_FILE),
        "level": found["calibration"].level,
        "coverage": cover["simultaneous"],
        "coverage_of_worst_decile_of_patients": cover["worst_decile_of_patients"],
        "missed_share": at["missed_share"],
        "exposures_per_minute": at["exposures_per_minute"],
        "share_of_the_exposures_of_periodic_imaging": found["share_of_the_exposures_of_periodic_imaging"],
        "fewer_frames_than_fluoroscopy": at["fewer_frames_than_fluoroscopy"],
        **({"patients_not_registered": ", ".join(left_out)} if left_out else {}),
        **{
            other["dataset"]: (
                f"coverage {other['coverage']['simultaneous']:.3f}, missed {other['adviser']['missed_share']:.3f}, "
                f"{other['adviser']['exposures_per_minute']:.1f} exposures a minute"
            )
            for other in found["made_otherwise"]
        },
    }
    return Answer(found, [shown])
