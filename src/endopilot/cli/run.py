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
        output: folder of all results; the report is report.html.
    """
    return run_volume(volume, output, config, series=series, phase=phase, target=target)
