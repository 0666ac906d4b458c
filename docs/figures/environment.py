"""Write the environments' specification, picture and speed into docs: `python docs/figures/environment.py`.

Takes some three minutes; nothing else should run meanwhile. With `--specification` the speed is not measured again.
"""

from __future__ import annotations

import inspect
import json
import subprocess
import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

sys.path.append(str(Path(__file__).parents[2]))  # where `benchmarks` is

from benchmarks.figures import fill
from endopilot.env.single import NavigateEnv
from endopilot.env.vector import NavigateVectorEnv

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
    said = inspect.getdoc(NavigateVectorEnv) or ""
    fill("concepts/environment-specification.md", "specification", said, dated=False)
    if "--specification" in sys.argv:
        return
    command = [sys.executable, "-m", "benchmarks", "env", "--json"]
    figures = json.loads(subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True).stdout)
    rows = [f"| {name} | {value} |" for name, value in figures.items() if name != "processor"]
    fill("evidence/environments.md", "bench", ["| figure | value |", "|---|---|", *rows])


if __name__ == "__main__":
    main()
