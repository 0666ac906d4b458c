"""Write the environments' picture and speed into docs: `python docs/figures/environment.py`.

Takes some three minutes; nothing else should run meanwhile.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

sys.path.append(str(Path(__file__).parents[2]))  # where `benchmarks` is

from benchmarks.figures import fill
from endopilot.env.single import NavigateEnv

ROOT = Path(__file__).parents[2]


def draw() -> None:
    """Draw what an environment shows of a wire on its way, each pixel as three."""
    env = NavigateEnv(observation="image", pixels=128)
    env.reset(seed=0)
    for _ in range(60):
        env.step([0.7, 0.4, -1.0])
    seen, *_ = env.step([0.7, 0.4, 1.0])
    shown = np.concatenate(list(seen["image"]), axis=1)
    plt.imsave(
        ROOT / "docs" / "images" / "environment_xray.png",
        np.kron(shown, np.ones((3, 3))),
        cmap="gray",
        vmin=0,
        vmax=255,
    )


def main() -> None:
    """Fill the page."""
    draw()
    command = [sys.executable, "-m", "benchmarks", "env", "--json"]
    figures = json.loads(subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True).stdout)
    rows = [f"| {name} | {value} |" for name, value in figures.items() if name != "processor"]
    fill("evidence/environments.md", "bench", ["| figure | value |", "|---|---|", *rows])


if __name__ == "__main__":
    main()
