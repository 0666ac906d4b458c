"""Draw the picture of docs/concepts/angiograms.md, and write the transit times into docs/evidence/angiograms.md."""

from __future__ import annotations

import shutil
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "src")]  # where `benchmarks` is

import numpy as np

from benchmarks.figures import fill
from endopilot.anatomy.io import write_anatomy
from endopilot.angiograms.config import AngiogramsConfig
from endopilot.angiograms.flow import Flow
from endopilot.angiograms.make import make_angiograms
from endopilot.atlas.atlas import AtlasConfig, make_patient, make_patient_tree

PICTURE = ROOT / "docs" / "images" / "angiograms.png"
ARTERIES = {
    "right coronary artery": ("rca", "3", (20.4, 3.0)),
    "left anterior descending artery": ("lca", "8", (36.2, 2.6)),
}
"""Kind of patient, section at whose end contrast is awaited, and published frames of 1/30 s (Gibson 1996)."""
PATIENTS, FRAMES_S = 30, 30


def transit_frames(vessel: str, section: str, velocity_mm_s: float) -> list[float]:
    """Return how many frames of 1/30 s the blood takes to the end of a section, in each patient who has it."""
    found = []
    for index in range(PATIENTS):
        tree, _ = make_patient_tree(AtlasConfig(vessel=vessel, seed=5, stenosis_share=0.0), index)
        flow = Flow(tree, velocity_mm_s)
        name = np.concatenate([np.array(tree.section_names)[branch.section] for branch in tree.branches])
        if (name == section).any():
            found.append(float(flow.transit_s[name == section].max()) * FRAMES_S)
    return found


def table() -> str:
    """Return the table of transit times as Markdown."""
    low, high = AngiogramsConfig().blood_mm_s
    rows = [
        "| frames of 1/30 s to the end of the | slowest blood | mean | fastest | published |",
        "| --- | --- | --- | --- | --- |",
    ]
    for name, (vessel, section, (mean, deviation)) in ARTERIES.items():
        frames = [np.median(transit_frames(vessel, section, speed)) for speed in (low, (low + high) / 2, high)]
        rows.append(f"| {name} | " + " | ".join(f"{value:.0f}" for value in frames) + f" | {mean} ± {deviation} |")
    return "\n".join(rows)


def draw() -> None:
    """Make a small data set, and keep its picture of samples."""
    with tempfile.TemporaryDirectory() as place:
        folders = []
        for index in range(4):
            anatomy = make_patient(AtlasConfig(vessel=("rca", "lca")[index % 2], seed=12), index)
            folders.append(Path(place) / anatomy.name)
            write_anatomy(anatomy, output=folders[-1])
        config = AngiogramsConfig(cines=2, seconds=1.6, injected_share=0.8, seed=1)
        make_angiograms(folders, output=Path(place) / "angiograms", config=config)
        shutil.copy(Path(place) / "angiograms" / "samples.png", PICTURE)


if __name__ == "__main__":
    fill("evidence/angiograms.md", "transit", table())
    draw()
