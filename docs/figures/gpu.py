"""Write what a GPU does into docs/evidence/performance.md: `make gpu-figures`, at most 30 minutes.

First the rod core, with a test of its agreement; then a slice of `make recipe-gpu`: a hundredth of its navigations,
and two minutes of each network's training.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from performance import ROOT, output, table

from benchmarks.figures import fill
from endopilot.models.config import WINDOW

PATIENTS, SEQUENCES = 10, 100
"""Of the slice; the recipe has 100 and 1000."""
TRAINING_SECONDS = 120
"""Of each of the four networks."""
FULL_NAVIGATIONS = 100 * 1000
SLICE = Path("runs/gpu-slice")


def kernel_rows() -> list[dict[str, Any]]:
    """Return the rows of `python -m benchmarks simulation --device cuda`, which leaves with 1 if its bar is not met."""
    command = [sys.executable, "-m", "benchmarks", "simulation", "--device", "cuda", "--json"]
    ran = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    if ran.returncode > 1:
        sys.exit(ran.stderr)
    return json.loads(ran.stdout)


def recipe_rows(folder: Path) -> list[dict[str, Any]]:
    """Return what the slice of the recipe in a folder measured, and what all of it would take."""
    work = json.loads((folder / "dataset" / "meta" / "manifest.json").read_text(encoding="utf-8"))["work"]
    share = FULL_NAVIGATIONS / (PATIENTS * SEQUENCES)
    rows = [
        {
            "stage": "navigations",
            "samples_per_second": round(work["samples"] / work["wall_seconds"], 1),
            "hours_of_the_full_recipe": round(share * work["wall_seconds"] / 3600, 2),
        }
    ]
    for model in ("paper",):
        manifest = json.loads((folder / model / "manifest.json").read_text(encoding="utf-8"))
        curves = json.loads((folder / model / "training.json").read_text(encoding="utf-8"))
        windows = work["samples"] // (PATIENTS * SEQUENCES) - WINDOW
        for network, result in curves.items():
            speed = result["curve"][-1]["samples_per_second"]
            samples = share * manifest["episodes"]["train"] * windows * manifest["config"]["epochs"]
            rows.append(
                {
                    "stage": f"training of {model}, {network}",
                    "samples_per_second": round(speed, 1),
                    "hours_of_the_full_recipe": round(samples / speed / 3600, 2),
                }
            )
    return rows


def main() -> None:
    """Run the measurements."""
    gpu = output("nvidia-smi", "--query-gpu=name", "--format=csv,noheader").splitlines()[0]
    test = ["tests/simulation/test_same_bits.py", "-k", "a_gpu_agrees_with_the_processor", "-rs"]
    agreement = output(sys.executable, "-m", "pytest", *test)
    if "1 passed" not in agreement:
        sys.exit(agreement)
    fill("evidence/performance.md", "gpu", f"{gpu}:\n\n{table(kernel_rows())}")
    started = time.perf_counter()
    size = [f"FULL={SLICE}", f"FULL_PATIENTS={PATIENTS}", f"FULL_SEQUENCES={SEQUENCES}"]
    training = f"FULL_TRAINING=--max-seconds {TRAINING_SECONDS}"
    subprocess.run(["make", "recipe-gpu", *size, training], cwd=ROOT, check=True)
    minutes = (time.perf_counter() - started) / 60
    rows = table(recipe_rows(ROOT / SLICE))
    text = f"{rows}\n\nThe slice took {minutes:.0f} minutes, with its evaluations."
    fill("evidence/performance.md", "gpu-recipe", text)


if __name__ == "__main__":
    main()
