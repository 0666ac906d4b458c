"""Measure what the simulator's settings cost a data set, and write the table of docs/evidence/dataset.md.

`python docs/figures/dataset.py FOLDER...`: data sets, one for each kind of vessel, named by their folders. The first
navigations of each patient are simulated again with every setting, and compared with the finest.
"""

from __future__ import annotations

import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.append(str(Path(__file__).parents[2]))  # where `benchmarks` is

from benchmarks.figures import fill
from endopilot.dataset.loader import read_dataset
from endopilot.devices.stack import Stack
from endopilot.models.episodes import Episodes
from endopilot.simulation.config import PRESETS, SimulatorConfig
from endopilot.simulation.simulate import simulate
from endopilot.simulation.trajectory import Trajectory

NAVIGATIONS = 3
HELD = 0.9
"""A wire is stuck where its drive feels this share of the pull limit."""
REFERENCE = PRESETS["accurate"]
SETTINGS = {
    "0.75 mm, 0.001 mm": SimulatorConfig(),
    "**0.75 mm, 0.01 mm**": SimulatorConfig(tolerance_mm=1e-2),
    "1 mm, 0.01 mm": SimulatorConfig(element_mm=1.0, tolerance_mm=1e-2),
    "1.25 mm, 0.01 mm": SimulatorConfig(element_mm=1.25, tolerance_mm=1e-2),
}
HEAD = ["vessels", "elements, tolerance", "tip error mm: median", "p95", "same branch", "wire stuck", "speed"]


def main(folders: list[str]) -> None:
    """Replace what stands between the page's marks."""
    rows = [HEAD, ["---"] * len(HEAD)]
    for folder in map(Path, folders):
        data = read_dataset(folder)
        episodes = Episodes.of_dataset(data[data.sequence < NAVIGATIONS])
        truth, _ = _simulated(episodes, REFERENCE)
        rows += [[folder.name, name, *_compared(episodes, truth, config)] for name, config in SETTINGS.items()]
        rows.append([folder.name, "reference: 0.3 mm, 0.001 mm", "", "", "", _held(episodes, truth), ""])
    fill("evidence/dataset.md", "settings", [f"| {' | '.join(row)} |" for row in rows])


def _simulated(episodes: Episodes, config: SimulatorConfig) -> tuple[list[Trajectory], float]:
    """Return the rollouts of each patient, and simulated seconds per second of one core."""
    rollouts, start = [], time.process_time()
    for name in np.unique(episodes.anatomy):
        data = episodes.select(episodes.anatomy == name)
        anatomy, device = episodes.anatomies[str(name)](), episodes.device
        rollouts.append(simulate(anatomy, device, data.command, initial=data.start, config=replace(config, threads=1)))
    return rollouts, 0.5 * episodes.tip[..., 0].size / (time.process_time() - start)


def _compared(episodes: Episodes, truth: list[Trajectory], config: SimulatorConfig) -> list[str]:
    rollouts, speed = _simulated(episodes, config)
    pairs = list(zip(rollouts, truth, strict=True))
    error = np.concatenate([np.linalg.norm(r.tip_position - t.tip_position, axis=-1).ravel() for r, t in pairs])
    same = np.mean(np.concatenate([(r.tip.branch == t.tip.branch).ravel() for r, t in pairs]))
    figures = [f"{np.median(error):.3f}", f"{np.percentile(error, 95):.2f}", f"{100 * same:.1f} %"]
    return [*figures, _held(episodes, rollouts), f"{speed:.0f}"]


def _held(episodes: Episodes, rollouts: list[Trajectory]) -> str:
    limit = HELD * Stack.of(episodes.device).wire.pull_limit_n
    return f"{100 * np.mean(np.concatenate([(r.base_force < -limit).ravel() for r in rollouts])):.2f} %"


if __name__ == "__main__":
    main(sys.argv[1:])
