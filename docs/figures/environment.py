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

from endopilot.env.single import NavigateEnv
from endopilot.env.vector import NavigateVectorEnv

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "environment.md"


def fill(name: str, text: str) -> None:
    """Replace what stands between the page's marks of some name."""
    begin, end = f"<!-- {name}:begin -->", f"<!-- {name}:end -->"
    page = PAGE.read_text(encoding="utf-8")
    PAGE.write_text(f"{page.split(begin)[0]}{begin}\n{text}\n{end}{page.split(end)[1]}", encoding="utf-8")


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
    fill("specification", (inspect.getdoc(NavigateVectorEnv) or "").replace("\n## ", "\n### "))
    if "--specification" in sys.argv:
        return
    command = [sys.executable, "-m", "benchmarks", "env", "--json"]
    figures = json.loads(subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True).stdout)
    rows = [f"| {name} | {value} |" for name, value in figures.items() if name != "processor"]
    fill("bench", "\n".join([f"{figures['processor']}:\n", "| figure | value |", "|---|---|", *rows]))


if __name__ == "__main__":
    main()
