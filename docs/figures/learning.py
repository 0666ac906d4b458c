"""Measure models on new patients, and write the tables of docs/evidence/learning.md and docs/evidence/advice.md.

`python docs/figures/learning.py FOLDER`: FOLDER holds what `make recipe-laptop` makes. Of each patient's navigations in
the split test the first is measured. What was measured of a model stands in `figures-MODEL.json` there, and is not
measured again.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from dataclasses import replace
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
from endopilot.simulation.engine_simulator import ENGINES

WORLDS = {
    "dataset": "as the model knows it, wires of ±20 %",
    "compliant-wall": "a compliant wall",
    "bent-tip": "another bend",
    "deeper-ostium": "a deeper ostium",
    "both": "heart and breath",
}
MODELS = {"wires": "simulated wires", "paper": "the paper's pair"}
TRUTHS = {"kirchhoff": "another engine", "rod": "the same core, wires of ±20 %"}
SPANS = ((0, 20), (20, 60), (60, 90))


def first_of_each(folder: Path, split: str) -> Dataset:
    """Return the first valid navigation of each patient of a split."""
    data = read_dataset(folder).of_split(split)
    data = data[np.flatnonzero(data.valid.all(axis=1))]
    return data[np.sort(np.unique(data.anatomy, return_index=True)[1])] if split == "test" else data


def spans(error: np.ndarray) -> list[list[float]]:
    """Return mean and median of Δtip's and of γtip's error over each of the spans, mm."""
    return [[float(of(error[:, a:b, i])) for a, b in SPANS for of in (np.mean, np.median)] for i in (0, 1)]


def driven(data: Dataset, engine: str, *, as_given: bool = False) -> Dataset:
    """Return navigations with the tips to which the commands lead true wires in an engine, or the wire as given."""
    tips = []
    for k in range(len(data)):
        of = data[k].set_up()
        stack = data.stack if as_given else of.stacks[0]
        friction = stack.frictions(np.full(1, stack.wire.friction)) if as_given else of.friction
        command, start = data[k].command, of.initial
        pushed_mm = np.maximum(command[..., 0], 0.0).sum() * data.sample_period_s
        reach_mm = float(start[..., 0].max() + pushed_mm)
        simulator = ENGINES[engine](of.anatomies, [stack], config=of.config, reach_mm=reach_mm)
        simulator.reset(inserted_length=start[..., 0], rotation=start[..., 1], friction=friction)
        tips.append(simulator.run(command, period_s=data.sample_period_s).tip)
    return replace(
        data,
        tip_abscissa=np.concatenate([tip.abscissa for tip in tips]),
        tip_offset=np.concatenate([tip.offset for tip in tips]),
    )


def predicted(folder: Path) -> dict[str, dict[str, Any]]:
    """Return what P1 errs by, by what moves the true wire and who predicts: `spans`, and s of a core a navigation."""
    data, found = first_of_each(folder / "dataset", "test"), dict[str, dict[str, Any]]()
    given = Episodes.of_dataset(driven(data, "rod", as_given=True)).tip[:, WINDOW:]
    for engine in TRUTHS:
        moved = driven(data, engine)
        true = Episodes.of_dataset(moved)
        rows = {"the wire as given": (given, 0.0), "held slack and offset": (hold_slack(moved), 0.0)}
        for model, title in MODELS.items():
            if (run := run_of(folder, model)) is not None:
                start = time.process_time()
                tip = load_model(run).rollout_forward(true).tip
                rows[title] = tip, (time.process_time() - start) / len(data)
        found[engine] = {
            title: [spans(np.abs(tip - true.tip[:, WINDOW:])), seconds] for title, (tip, seconds) in rows.items()
        }
    return found


def run_of(folder: Path, model: str) -> str | Path | None:
    """Return what names a model for `load_model`; None where it was not trained."""
    if model == "wires":
        return model
    return folder / model if (folder / model / "manifest.json").exists() else None


def measured(folder: Path, run: str | Path) -> dict[str, Any]:
    """Return the advice of a model."""
    found, config = dict[str, Any](), AdviseConfig()

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


def p1_rows(found: dict[str, dict[str, Any]]) -> Iterator[str]:
    """Yield the rows of P1: mean and median of both errors over the spans, mm, and processor time."""
    yield "| truth | | Δtip | γtip | processor, s a navigation |"
    yield "|---|---|---|---|---|"
    for engine, truth in TRUTHS.items():
        for title, (errors, seconds) in found[engine].items():
            cells = [" ".join(f"{each[k]:.3f} ({each[k + 1]:.3f})" for k in (0, 2, 4)) for each in errors]
            yield f"| {truth} | {title} | {cells[0]} | {cells[1]} | {f'{seconds:.1f}' if seconds else '–'} |"


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
        if not path.exists() and (run := run_of(folder, model)) is not None:
            write_json(path, measured(folder, run))
        if path.exists():
            models[model] = read_json(path)
    path = folder / "figures-p1.json"
    if not path.exists():
        write_json(path, predicted(folder))
    fill("evidence/learning.md", "headline", p1_rows(read_json(path)))
    fill("evidence/advice.md", "worlds", advice_rows(models))
