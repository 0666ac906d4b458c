"""Write the scores of `examples/recurrent_policy.py` on the ladder, and draw how it learned.

`python docs/figures/recurrent_ppo.py FOLDER`: the table is of submissions/recurrent.json and goes into
docs/evidence/environments.md; FOLDER holds first.csv, second.csv and xray.csv, which the example wrote run by run, and
the curves go into docs/images/recurrent_ppo.png.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

sys.path.append(str(Path(__file__).parents[2]))  # where `benchmarks` is

from benchmarks.figures import DOCS, fill
from endopilot.ladder.submission import read_submission

SUBMISSION = Path(__file__).parents[2] / "submissions" / "recurrent.json"
PAGE = "evidence/environments.md"
RUNS = ("first", "second", "xray")


def table() -> list[str]:
    """Return the scores in the ladder's patients."""
    lines, every = ["| task | safe (successes) | exposures |", "|---|---|---|"], []
    for name, entries in read_submission(SUBMISSION).navigations.items():
        rows = [(one.success and one.safe, one.success, one.exposures) for one in entries]
        safe, success, exposures = np.array(rows, dtype=float).T
        lines.append(f"| {name} | {safe.sum():.0f} ({success.sum():.0f}) of {len(rows)} | {exposures.mean():.1f} |")
        every += rows
    safe, _, exposures = np.array(every, dtype=float).mean(axis=0)
    return [*lines, f"| all | {100 * safe:.0f} % | {exposures:.1f} |"]


def draw(folder: Path, path: Path) -> None:
    """Draw what share of the episodes that ended was safe, and the exposures that they took: running means."""
    runs = [np.loadtxt(folder / f"{name}.csv", delimiter=",", skiprows=1) for name in RUNS]
    begun = np.cumsum([0.0, *(run[-1, 0] for run in runs)])
    seconds = np.concatenate([at + run[:, 0] for at, run in zip(begun, runs, strict=False)])
    _, _, success, exposures = np.concatenate(runs).T
    width = max(len(seconds) // 20, 1)  # episodes that run out of time end in bursts
    mean, minutes = np.ones(width) / width, seconds[width - 1 :] / 60
    figure = Figure(figsize=(8, 3.2), layout="constrained")
    for ax, values, label in zip(
        figure.subplots(1, 2), (100 * success, exposures), ("safe success, %", "exposures of an episode"), strict=True
    ):
        ax.plot(minutes, np.convolve(values, mean, mode="valid"))
        ax.set(xlabel="minutes", ylabel=label, ylim=(0, None))
        ax.grid(alpha=0.3)
        for at in begun[1:-1]:
            ax.axvline(at / 60, color="0.6", linestyle=":")  # another run
    figure.savefig(path, dpi=110)


def main() -> None:
    """Write the table and draw the curves."""
    draw(Path(sys.argv[1]), DOCS / "images" / "recurrent_ppo.png")
    fill(PAGE, "policies", table())


if __name__ == "__main__":
    main()
