"""Measure models on new patients, and write the tables of docs/evidence/learning.md and docs/evidence/advice.md.

`python docs/figures/learning.py FOLDER`: FOLDER holds what `make recipe-laptop` makes. Of each patient's navigations in
the split test the first is measured. What was measured of a model stands in `figures-MODEL.json` there, and is not
measured again.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

sys.path.append(str(Path(__file__).parents[2]))  # where `benchmarks` is

from benchmarks.figures import fill
from endopilot.belief.advise import follows
from endopilot.belief.bands import Calibration
from endopilot.belief.monitoring import AdviseConfig, Followed, calibrate, coverage, follow_all, measure
from endopilot.dataset.loader import Dataset, read_dataset
from endopilot.evaluation.evaluate import hold_slack
from endopilot.files import read_json, write_json
from endopilot.models.checkpoint import load_model
from endopilot.models.config import WINDOW
from endopilot.models.episodes import Episodes

WORLDS = {
    "dataset": "as the model knows it, wires of ±20 %",
    "compliant-wall": "a compliant wall",
    "bent-tip": "another bend",
    "deeper-ostium": "a deeper ostium",
    "both": "heart and breath",
}
MODELS = {"wires": "simulated wires", "paper": "the paper's pair", "networks": "causal networks, removed since"}
SPANS = ((0, 20), (20, 60), (60, 90))


def first_of_each(folder: Path, split: str) -> Dataset:
    """Return the first valid navigation of each patient of a split."""
    data = read_dataset(folder).of_split(split)
    data = data[np.flatnonzero(data.valid.all(axis=1))]
    return data[np.sort(np.unique(data.anatomy, return_index=True)[1])] if split == "test" else data


def spans(error: np.ndarray) -> list[list[float]]:
    """Return mean and median of Δtip's and of γtip's error over each of the spans, mm."""
    return [[float(of(error[:, a:b, i])) for a, b in SPANS for of in (np.mean, np.median)] for i in (0, 1)]


def measured(folder: Path, model: str) -> dict[str, Any]:
    """Return P1 and the advice of a model."""
    run = model if model == "wires" else folder / model
    episodes = Episodes.of_dataset(first_of_each(folder / "dataset", "test"))
    start = time.process_time()
    tip = load_model(run).rollout_forward(episodes).tip
    found: dict[str, Any] = {"p1_cpu_s_per_nav": (time.process_time() - start) / len(episodes)}
    found["p1"], config = spans(np.abs(tip - episodes.tip[:, WINDOW:])), AdviseConfig()

    def followed(name: str, split: str, bands: Calibration | None = None) -> list[Followed]:
        return follow_all(first_of_each(folder / name, split), follows(Path(run)), config, bands)[0]

    fitted, own = (followed("dataset", split) for split in ("train", "calibrate"))
    bands = calibrate(fitted, own, config.adviser.level, "")
    for world in WORLDS:
        test = followed(world, "test", bands)
        cover, policy = coverage(test), measure(test)
        found[world] = {
            "cover": cover["simultaneous"],
            "samplewise": cover["samplewise"],
            "mae": cover["error_mae_mm"],
            "missed": policy["missed_share"],
            "evenly": policy["missed_evenly_share"],
            "exposures": policy["exposures_per_minute"],
            "n": cover["intervals"],
        }
    return found


def p1_rows(folder: Path, models: dict[str, dict[str, Any]]) -> Iterator[str]:
    """Yield the rows of P1: mean and median of both errors over the spans, mm, and processor time."""
    yield "| | Δtip | γtip | processor, s a navigation |"
    yield "|---|---|---|---|"
    data = first_of_each(folder / "dataset", "test")
    held = np.abs(hold_slack(data) - Episodes.of_dataset(data).tip[:, WINDOW:])
    for name, p1, seconds in [
        *((MODELS[name], found["p1"], f"{found['p1_cpu_s_per_nav']:.1f}") for name, found in models.items()),
        ("held slack and offset", spans(held), "–"),
    ]:
        cells = [" ".join(f"{each[k]:.3f} ({each[k + 1]:.3f})" for k in (0, 2, 4)) for each in p1]
        yield f"| {name} | {cells[0]} | {cells[1]} | {seconds} |"


def advice_rows(models: dict[str, dict[str, Any]]) -> Iterator[str]:
    """Yield the rows of the advice in worlds."""
    yield (
        "| patients | model | bands hold throughout | at samples | error of Δtip, γtip, mm | missed "
        "| by as many at even times | a minute |"
    )
    yield "|---|---|---|---|---|---|---|---|"
    for world, title in WORLDS.items():
        for name, found in models.items():
            if world not in found:
                continue
            at = found[world]
            yield (
                f"| {title} | {MODELS[name]} | {at['cover']:.0%} of {at['n']} | {at['samplewise']:.0%} | "
                f"{at['mae'][0]:.2f}, {at['mae'][1]:.3f} | {at['missed']:.1%} | {at.get('evenly', np.nan):.1%} "
                f"| {at['exposures']:.1f} |"
            )


if __name__ == "__main__":
    folder, models = Path(sys.argv[1]), {}
    for model in MODELS:
        path = folder / f"figures-{model}.json"
        if not path.exists() and (model == "wires" or (folder / model / "manifest.json").exists()):
            write_json(path, measured(folder, model))
        if path.exists():
            models[model] = read_json(path)
    fill("evidence/learning.md", "headline", p1_rows(folder, models))
    fill("evidence/advice.md", "worlds", advice_rows(models))
