"""Draw how three seeds of PPO and SAC learned, and write what they drove then into docs/evidence/environments.md.

`python docs/figures/train_sb3.py`: `examples/train_sb3.py` trains what is not yet in runs/rl, ALGORITHM-SEED.json; the
curves go into docs/images/train_sb3.png.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from scipy.stats import t

ROOT = Path(__file__).parents[2]
sys.path.append(str(ROOT))  # where `benchmarks` is

from benchmarks.figures import DOCS, fill, markdown_table
from endopilot.ladder.scores import interval

PAGE = "evidence/environments.md"
ALGORITHMS, SEEDS, MINUTES = ("ppo", "sac"), 3, 0.4
DRIVEN, WIDTH = 64, 16
"""Rotations from which each seed was judged, nearly the same ones for all, and episodes of a running mean."""


def read(algorithm: str, seed: int) -> dict[str, Any]:
    """Return what a training told; it is done first if it was not yet."""
    path = ROOT / "runs" / "rl" / f"{algorithm}-{seed}.json"
    if not path.exists():
        line = [sys.executable, str(ROOT / "examples" / "train_sb3.py"), "--minutes", str(MINUTES)]
        subprocess.run([*line, "--algorithm", algorithm, "--seed", str(seed), "--output", str(path)], check=True)
    return json.loads(path.read_text(encoding="utf-8"))


def table(runs: dict[str, list[dict[str, Any]]]) -> list[str]:
    """Return the table: safe success with Wilson's interval over rotations, others with Student's over seeds."""
    rows = []
    for name, seeds in runs.items():
        low, high = interval(round(DRIVEN * float(np.mean([seed["safe"] for seed in seeds]))), DRIVEN)
        each = ", ".join(f"{100 * seed['safe']:.0f}" for seed in seeds)
        lasts = [np.mean([one[1] for one in seed["episodes"][-(len(seed["episodes"]) // 5) :]]) for seed in seeds]
        steps = _mean([seed["steps"] for seed in seeds], ",.0f")
        rows.append(
            (
                name.upper(),
                f"{60 * MINUTES:g}",
                steps,
                f"{each} ({100 * low:.0f}–{100 * high:.0f})",
                _mean(lasts, ".2f"),
            )
        )
    pushed = np.mean([seed["pushed"] for seeds in runs.values() for seed in seeds])
    head = ("algorithm", "processor time, s", "steps", "safe success, % (95 %)", "return of the last fifth of episodes")
    return markdown_table(head, [*rows, ("pushing alone", "–", "–", f"{100 * pushed:.0f}", "–")])


def _mean(values: Sequence[float], form: str) -> str:
    middle, half = np.mean(values), t.ppf(0.975, len(values) - 1) * np.std(values, ddof=1) / np.sqrt(len(values))
    return f"{middle:{form}} ± {half:{form}}".replace(",", " ")


def draw(runs: dict[str, list[dict[str, Any]]], path: Path) -> None:
    """Draw running means of the episodes that ended, a line for each seed."""
    figure = Figure(figsize=(8, 3.2), layout="constrained")
    axes = figure.subplots(1, 2)
    for place, (name, seeds) in enumerate(runs.items()):
        for number, seed in enumerate(seeds):
            seconds, returns, safe = np.array(seed["episodes"], dtype=float).T
            for ax, values in zip(axes, (returns, 100 * safe), strict=True):
                label = name.upper() if number == 0 else None
                ended = np.minimum(np.arange(1, len(values) + 1), WIDTH)
                mean = np.convolve(values, np.ones(WIDTH))[: len(values)] / ended
                ax.plot(seconds, mean, color=f"C{place}", label=label, linewidth=1)
    for ax, title in zip(axes, ("return of an episode", "safe success, %"), strict=True):
        ax.set(xlabel="processor time, s", ylabel=title)
        ax.grid(alpha=0.3)
    axes[0].legend()
    figure.suptitle(f"Three seeds each, mean over the last {WIDTH} episodes that ended", fontsize=10)
    figure.savefig(path, dpi=110)


def main() -> None:
    """Draw the curves and write the table."""
    runs = {name: [read(name, seed) for seed in range(SEEDS)] for name in ALGORITHMS}
    draw(runs, DOCS / "images" / "train_sb3.png")
    fill(PAGE, "algorithms", table(runs))


if __name__ == "__main__":
    main()
