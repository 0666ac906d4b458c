"""`endopilot demo`: six synthetic patients -> everything from the CT angiogram to the report."""

from __future__ import annotations

from pathlib import Path

from endopilot.cli.arguments import Figures, OutputFolder
from endopilot.pipeline.study import DemoConfig, run_demo


def command(*, output: OutputFolder = Path("runs/demo"), config: DemoConfig = DemoConfig()) -> Figures:
    """Run every stage once on synthetic patients: CT angiogram, segmentation, anatomy, simulation, training, report.

    An interrupted demo goes on where it stopped when the same command is given again.

    Args:
        output: folder of all results; the report is report.html.
    """
    return run_demo(output, config)
