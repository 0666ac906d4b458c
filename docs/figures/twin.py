"""Measure the twin on patients of the atlas and write its table into docs/models.md.

`python docs/figures/twin.py FOLDER`: FOLDER takes the patients and their navigations; an interrupted run goes on there.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from endopilot.anatomy.atlas import AtlasConfig, synthesize_one
from endopilot.anatomy.io import write_anatomy
from endopilot.dataset.generate import DatasetConfig, generate_dataset
from endopilot.dataset.loader import load_dataset
from endopilot.models.config import TwinConfig
from endopilot.models.twin import TwinPredictor
from endopilot.simulation.device import Device, read_device
from endopilot.simulation.simulator import SimulatorConfig

PAGE = Path(__file__).parents[1] / "models.md"
PATIENTS, SEED, SEQUENCES, GIVEN, DEEPER_MM = 10, 600, 6, 30, 0.3
SPANS = (("0-10 s", 30, 50), ("10-30 s", 50, 90), ("30-45 s", 90, 120))


def measure(folder: Path) -> list[str]:
    """Return the rows of the table."""
    patients = []
    for index in range(PATIENTS):
        anatomy = synthesize_one(AtlasConfig(seed=SEED), index)
        patients.append(folder / "patients" / anatomy.name)
        if not patients[-1].exists():
            write_anatomy(anatomy, patients[-1])
    config = DatasetConfig(sequences=SEQUENCES, friction=(0.08, 0.12))
    generate_dataset(patients, folder / "dataset", read_device("workhorse-014"), config)
    episodes = load_dataset(folder / "dataset").of_split("test")
    rows = ["| ostium | span | Δ MAE, median, mm | γ MAE, mm |", "|---|---|---|---|"]
    for deeper in (0.0, DEEPER_MM):
        told = replace(episodes, initial_inserted_length=episodes.initial_inserted_length - deeper)
        twin = TwinPredictor(
            device=Device.from_record(episodes.manifest["device"]),
            simulator=SimulatorConfig(**episodes.manifest["config"]["simulator"]),
            config=TwinConfig(),
        )
        tip = twin.foretell(told, np.arange(episodes.valid.shape[1]) < GIVEN).tip
        along, off = np.abs(tip[..., 0] - episodes.tip_abscissa), np.abs(tip[..., 1] - episodes.tip_offset)
        rows += [
            f"| {deeper:g} mm deeper | {name} | {along[:, a:b].mean():.3f}, {np.median(along[:, a:b]):.3f} | "
            f"{off[:, a:b].mean():.3f} |"
            for name, a, b in SPANS
        ]
    return [*rows, "", f"({len(episodes)} navigations of {len(np.unique(episodes.anatomy))} patients)"]


if __name__ == "__main__":
    text = PAGE.read_text(encoding="utf-8")
    head, rest = text.split("<!-- twin:begin -->\n")
    tail = rest.split("<!-- twin:end -->")[1]
    table = "\n".join(measure(Path(sys.argv[1])))
    PAGE.write_text(f"{head}<!-- twin:begin -->\n{table}\n<!-- twin:end -->{tail}", encoding="utf-8")
