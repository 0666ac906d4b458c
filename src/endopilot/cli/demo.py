"""`endopilot demo`: six synthetic patients -> everything from the CT angiogram to the report."""

from __future__ import annotations

from pathlib import Path

from endopilot.cli.arguments import OutputFolder, show
from endopilot.pipeline.study import DemoConfig, run_demo


def command(
    *,
    output: OutputFolder = Path("runs/demo"),
    json: bool = False,
    config: DemoConfig = DemoConfig(),
) -> None:
    """Run every stage once on synthetic patients: CT angiogram, segmentation, anatomy, simulation, training, report.

    An interrupted demo goes on where it stopped when the same command is given again.

    Args:
        output: folder of all results; the report is report.html.
        json: print the figures as JSON.
        config: size of the demo.
    """
    show(run_demo(output, config), as_json=json)
