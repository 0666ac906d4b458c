"""`endopilot run`: one CT angiogram -> everything up to the report, and a wire driven to a target."""

from __future__ import annotations

from tyro.conf import Positional

from endopilot.cli.arguments import Existing, Figures, OutputFolder
from endopilot.pipeline.study import RunConfig, run_volume


def command(
    volume: Positional[Existing],
    /,
    *,
    output: OutputFolder,
    target: str | None = None,
    series: str | None = None,
    phase: str | None = None,
    config: RunConfig = RunConfig(),
) -> Figures:
    """Run every stage on one patient, from the CT angiogram to the report.

    With --target the agent drives the wire to a place of the vessel, as `endopilot navigate` does with its defaults;
    the page of that navigation is in the folder `navigation`. Simulated wires are evaluated in this
    patient; --training-seconds trains networks on it instead.

    An interrupted run goes on where it stopped when the same command is given again.

    Args:
        volume: DICOM folder or file, NIfTI, NRRD or MHA, in HU.
        output: folder of all results; the report is report.html.
        target: section label such as 4 or LAD, or point X,Y,Z in LPS mm, to which the agent drives the wire.
        series: number or instance UID of the series, where a DICOM folder holds several.
        phase: cardiac phase, such as 75 (per cent), where a DICOM series holds several.
        config: segmentation, device and size of the study.
    """
    return run_volume(volume, output, config, series=series, phase=phase, target=target)
