"""Score the policies of `examples/recurrent_ppo.py`, and draw how they learned.

`python docs/figures/recurrent_ppo.py FOLDER`: FOLDER holds what the example wrote, state.npz, xray.npz, and of the runs
that are drawn a .csv. The table goes into docs/evidence/environments.md, the curves into docs/images/recurrent_ppo.png.
"""

from __future__ import annotations

import runpy
import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

sys.path.append(str(Path(__file__).parents[2]))  # where `benchmarks` is

from benchmarks.figures import DOCS, fill

EXAMPLE = Path(__file__).parents[2] / "examples" / "recurrent_ppo.py"
PAGE = "evidence/environments.md"
POLICIES = {"state": "all is observed", "xray": "seeing costs"}


def table(folder: Path) -> list[str]:
    """Return the scores in the ladder's patients."""
    score = runpy.run_path(str(EXAMPLE))["score"]
    scores = {name: score(folder / f"{name}.npz") for name in POLICIES if (folder / f"{name}.npz").exists()}
    titles = [POLICIES[name] for name in scores] + ["exposures"]
    lines = [f"| task | {' | '.join(titles)} |", "|---" * (1 + len(titles)) + "|"]
    for rows in zip(*scores.values(), strict=True):
        cells = [f"{safe} ({success}) of {count}" for _, safe, success, count, _ in rows]
        lines.append(f"| {rows[0][0]} | {' | '.join(cells)} | {rows[-1][4]:.1f} |")
    shares = [sum(row[1] for row in rows) / sum(row[3] for row in rows) for rows in scores.values()]
    exposures = np.mean([row[4] for row in list(scores.values())[-1]])
    lines.append(f"| all | {' | '.join(f'{share:.0%}'.replace('%', ' %') for share in shares)} | {exposures:.1f} |")
    return lines


def draw(folder: Path, path: Path) -> None:
    """Draw what share of the episodes that ended was safe, and the exposures that they took: running means."""
    figure = Figure(figsize=(8, 3.2), layout="constrained")
    safe, seen = figure.subplots(1, 2)
    for name, title in POLICIES.items():
        if not (folder / f"{name}.csv").exists():
            continue
        seconds, _, success, exposures = np.loadtxt(folder / f"{name}.csv", delimiter=",", skiprows=1).T
        width = max(len(seconds) // 8, 1)  # episodes that run out of time end in bursts
        mean, minutes = np.ones(width) / width, seconds[width - 1 :] / 60
        safe.plot(minutes, 100 * np.convolve(success, mean, mode="valid"), label=title)
        if exposures.any():
            seen.plot(minutes, np.convolve(exposures, mean, mode="valid"), color="C1", label=title)
    safe.set(xlabel="minutes", ylabel="safe success, %", ylim=(0, 102))
    seen.set(xlabel="minutes", ylabel="exposures of an episode", ylim=(0, None))
    for ax in (safe, seen):
        ax.grid(alpha=0.3)
        ax.legend()
    figure.savefig(path, dpi=110)


def main() -> None:
    """Write the table and draw the curves."""
    folder = Path(sys.argv[1])
    draw(folder, DOCS / "images" / "recurrent_ppo.png")
    fill(PAGE, "policies", table(folder))


if __name__ == "__main__":
    main()
