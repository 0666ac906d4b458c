"""`endopilot demo` and `run`: every stage in a row, of synthetic patients or of one CT angiogram."""

from __future__ import annotations

from pathlib import Path

from tyro.conf import Positional

from endopilot.cli.arguments import Existing, Figures, OutputFolder
from endopilot.pipeline.study import DemoConfig, RunConfig, run_demo, run_volume


def demo_command(*, output: OutputFolder = Path("runs/demo"), config: DemoConfig = DemoConfig()) -> Figures:
    """Run every stage once on synthetic patients: CT angiogram, segmentation, anatomy, simulation, training, report.

    An interrupted demo goes on where it stopped when the same command is given again.

    Args:
        output: folder of all results; the report is report.html.
    """
    return run_demo(output, config)


def run_command(
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
