"""What the base install must do: make and read an anatomy, simulate, plan, navigate. It needs no pytest."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

import endopilot


def main() -> None:
    """Go from a synthetic patient to a navigation, and print where the package is."""
    made = next(endopilot.make_atlas())
    with tempfile.TemporaryDirectory() as folder:
        endopilot.write_anatomy(made, output=Path(folder) / "patient")
        anatomy = endopilot.read_anatomy(Path(folder) / "patient")
    wire = endopilot.read_wire("workhorse-014")
    rollout = endopilot.simulate(anatomy, wire, np.full((2, 20, 2), [4.0, 0.5]))
    assert rollout.valid.all()
    assert (rollout.tip.abscissa[:, -1] > 30).all(), rollout.tip.abscissa[:, -1]
    x, y, z = anatomy.tree.longest_path().points[40]
    plan = endopilot.plan(anatomy, f"{x},{y},{z}", config=endopilot.PlanConfig(seconds=20.0), device=wire)
    assert plan.reached
    record = endopilot.NavigationLoop(plan.navigation, "forward").run()
    assert record.seconds > 0
    print(endopilot.__file__)


if __name__ == "__main__":
    main()
