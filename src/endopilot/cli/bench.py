"""`endopilot bench`: speed of the rod core together with its accuracy."""

from __future__ import annotations

from typing import Literal

from tyro.conf import Positional

from endopilot.cli.arguments import show
from endopilot.simulation.bench import bench_simulation


def command(subject: Positional[Literal["simulation"]] = "simulation", /, *, json: bool = False) -> None:
    """Measure the rod core on the reference scenario: simulated seconds per second, and the error that goes with it.

    Args:
        subject: what to measure.
        json: print the figures as JSON.
    """
    measure = {"simulation": bench_simulation}[subject]
    show(measure(), as_json=json)
