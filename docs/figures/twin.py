"""Measure the twin on the new patients of docs/evidence/learning.md and write its table there.

`python docs/figures/twin.py FOLDER`: FOLDER holds `dataset`, made by the commands of the packaged model's card. The
twin gets a friction and a tip stiffness from which the truth differs by up to 20 %, other ones for each patient.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.append(str(Path(__file__).parents[2]))  # where `benchmarks` is

from benchmarks.figures import fill
from endopilot.dataset.loader import Dataset, read_dataset
from endopilot.devices.device import Wire
from endopilot.models.config import WINDOW, TwinConfig
from endopilot.models.episodes import Episodes
from endopilot.models.twin import TwinPredictor
from endopilot.settings import from_record
from endopilot.simulation.config import SimulatorConfig

SEED, OFF, DEEPER_MM = 600, 0.2, 0.3
SPANS = (("0-10 s", 30, 50), ("10-30 s", 50, 90), ("30-45 s", 90, 120))


def believed(episodes: Dataset, index: int) -> TwinPredictor:
    """Return a twin whose friction and tip stiffness are so far from the truth as the index of a patient says."""
    device = from_record(Wire, episodes.manifest["device"])
    friction, stiffness = np.random.Generator(np.random.Philox([SEED, index])).uniform(1 - OFF, 1 + OFF, 2)
    nominal = replace(device, friction=device.friction / friction)
    return TwinPredictor(
        device=nominal.with_tip(bend_rad=nominal.tip_bend_rad, stiffness_factor=1 / stiffness),
        simulator=SimulatorConfig(**episodes.manifest["config"]["simulator"]),
        config=TwinConfig(),
    )


def rows(episodes: Dataset, sequences: int, deeper_mm: float) -> Iterator[str]:
    """Yield the rows of the table for the first navigations of every patient."""
    along, off, found = [], [], []
    for index, name in enumerate(np.unique(episodes.anatomy)):
        one = episodes[np.flatnonzero(episodes.anatomy == name)[:sequences]]
        given = Episodes.of_dataset(replace(one, initial=one.initial - np.array([deeper_mm, 0.0])))
        twin = believed(one, index)
        predicted = twin.predict(given, np.arange(one.valid.shape[1]) < WINDOW)
        along.append(np.abs(predicted.tip[..., 0] - one.tip_abscissa[:, :, 0]))
        off.append(np.abs(predicted.tip[..., 1] - one.tip_offset[:, :, 0]))
        found.append(np.abs(predicted.parameters[:, 0] * twin.device.friction / one.friction - 1))
        print(f"{name}: {along[-1][:, WINDOW:].mean():.4f} mm, {off[-1][:, WINDOW:].mean():.4f} mm", file=sys.stderr)
    delta, gamma = np.concatenate(along), np.concatenate(off)
    count = f"{len(delta)} of {len(along)} patients"
    for name, a, b in SPANS:
        yield (
            f"| {count}, ostium {deeper_mm:g} mm deeper | {name} | {delta[:, a:b].mean():.3f}, "
            f"{np.median(delta[:, a:b]):.3f} | {gamma[:, a:b].mean():.3f} |"
        )
    yield f"| the friction that it finds | | errs by {np.concatenate(found).mean():.1%} on average | |"


def measure(folder: Path) -> Iterator[str]:
    """Yield the rows of the table."""
    yield from ("| navigations | span | Δ MAE, median, mm | γ MAE, mm |", "|---|---|---|---|")
    episodes = read_dataset(folder / "dataset").of_split("test")
    yield from rows(episodes, 2, 0.0)
    yield from rows(episodes, 1, DEEPER_MM)


if __name__ == "__main__":
    fill("evidence/learning.md", "twin", measure(Path(sys.argv[1])))
