"""`endopilot demo`: six synthetic patients, the whole way from CTA to report."""

from __future__ import annotations

from pathlib import Path

from endopilot.cli.arguments import OutputFolder, show
from endopilot.pipeline import DemoConfig, run_demo


def command(
    *,
    output: OutputFolder = Path("runs/demo"),
    json: bool = False,
    config: DemoConfig = DemoConfig(),
) -> None:
    """Go the whole way once on synthetic patients: CTA, segmentation, anatomy, simulation, learning, report.

    An interrupted demo goes on where it stopped when the same command is given again.

    Args:
        output: folder of everything the demo makes; the report is report.html in it.
        json: print the figures as JSON.
        config: size of the demo.
    """
    show(run_demo(output, config), as_json=json)
