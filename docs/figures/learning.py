"""Write what the models reach into the tables of docs/evidence/learning.md.

`python docs/figures/learning.py FOLDER`: FOLDER holds the dataset, the runs and the evaluations that the page's
commands make; what is not there is left out.
"""

from __future__ import annotations

import re
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch

sys.path.append(str(Path(__file__).parents[2]))  # where `benchmarks` is

from benchmarks.figures import made_on
from endopilot.dataset.loader import Dataset, read_dataset
from endopilot.devices.device import read_wire
from endopilot.evaluation.metrics import OFF_WALL_MM
from endopilot.evaluation.protocols import hold_slack
from endopilot.files import read_json
from endopilot.models.causal import CausalPredictor
from endopilot.models.checkpoint import load_model
from endopilot.models.config import PRETRAINED, WINDOW
from endopilot.models.episodes import Episodes, Prediction, jumps
from endopilot.models.sequences import play_tables, unfold
from endopilot.models.simulated_wires import FRICTION_FACTORS

PAGE = Path(__file__).parents[1] / "evidence" / "learning.md"
OURS = f"`{PRETRAINED}`"
RUNS = {"the paper's pair": "paper"}
"""Runs of `make recipe-laptop`, by the name of the row; those that are not there are left out."""
PATIENTS = {
    "atlas, wires of ±20 %": "dataset",
    "atlas, moving, wires of ±20 %": "moving",
    "real, wires of ±20 %": "real-varied",
    "atlas": "new",
    "real": "real",
}
"""Datasets whose split test is measured on, by the name of the patients; those that are not there are left out."""
RADIUS_MM = read_wire("workhorse-014").tip_radius_mm
SPANS = ((30, 50), (50, 90), (90, 120))
LIKELY = 0.1
"""Probability from which on a jump counts as announced."""


def row(name: str, off: np.ndarray) -> str:
    """Return a row of a table: mean and median of both errors over the three spans, mm."""
    cells = [
        " ".join(f"{off[:, a:b, i].mean():.3f} ({np.median(off[:, a:b, i]):.3f})" for a, b in SPANS) for i in (0, 1)
    ]
    return f"| {name} | {cells[0]} | {cells[1]} |"


def measured(folder: Path) -> Iterator[tuple[str, Dataset]]:
    """Yield the valid navigations of patients that nothing was trained on, by the name of the patients."""
    for patients, name in PATIENTS.items():
        if (folder / name / "meta" / "manifest.json").is_file():
            data = read_dataset(folder / name).of_split("test")
            yield patients, data[np.flatnonzero(data.valid.all(axis=1))]


def p1_rows(folder: Path) -> tuple[list[str], list[str]]:
    """Return P1 in new patients, every run beside what learns nothing, and how well jumps are announced.

    Of jumps: how often tips jump, what of the error these navigations carry, and the probabilities.
    """
    headline, jumping = [], []
    for patients, data in measured(folder):
        truth = np.stack([data.tip_abscissa, data.tip_offset], axis=-1)[:, WINDOW:, 0].astype(float)
        clear = (data.lumen_radius - data.tip_offset)[:, WINDOW:, 0] - RADIUS_MM > OFF_WALL_MM
        episodes = Episodes.of_dataset(data)
        vessels, patient = play_tables(episodes), np.unique(data.anatomy, return_inverse=True)[1]
        observed = np.tile(np.arange(data.valid.shape[1]) < WINDOW, (len(data), 1))
        played = unfold("forward", vessels, patient, episodes, observed).guess
        there = {name: folder / run for name, run in RUNS.items() if (folder / run / "manifest.json").is_file()}
        runs = {name: load_model(run) for name, run in there.items()}
        ours = load_model(PRETRAINED)
        assert isinstance(ours, CausalPredictor)
        found = ours.predict(episodes, observed)
        jumping.append(f"| {patients} | {OURS} | {_jump_cells(episodes, found)} |")
        tips = {OURS: found.tip[:, WINDOW:]}
        for name, run in runs.items():
            tips[name] = run.rollout_forward(episodes).tip
        tips["play operator alone"] = played[:, WINDOW:]
        for name, seen in (("simulated wire as given", np.zeros_like(observed)), ("simulated wire, fitted", observed)):
            wire = ours.wires.tips(episodes, seen).tip[:, :, FRICTION_FACTORS.index(1.0)]
            tips[name] = np.where(np.isfinite(wire), wire, played)[:, WINDOW:]
        held = tips["held slack"] = hold_slack(data, WINDOW)
        scale = np.sqrt(((held - truth) ** 2).mean(axis=(0, 1)))
        for name, tip in tips.items():
            off = np.abs(tip - truth)
            skills = 1 - np.sqrt((off**2).mean(axis=(0, 1))) / scale
            cells = row(f"{patients} | {name}", np.pad(off, ((0, 0), (WINDOW, 0), (0, 0))))
            headline.append(f"{cells} {off[clear][:, 1].mean():.3f} | {skills[0]:.2f} {skills[1]:.2f} |")
    return headline, jumping


def _jump_cells(episodes: Episodes, found: Prediction) -> str:
    jumping = jumps(episodes.tip[..., 0].astype(float), episodes.proximal[..., 0].astype(float))[:, WINDOW:]
    said = found.jump[:, WINDOW:]
    off = np.abs(found.tip - episodes.tip)[:, WINDOW:, 0]
    within = (off < found.spread[:, WINDOW:, 0]).mean()
    return (
        f"{jumping.sum(axis=1).mean():.2f} | {off[jumping.any(axis=1)].sum() / off.sum():.0%} | "
        f"{said[jumping].mean():.2f} | {said[~jumping].mean():.4f} | {(said[jumping] > LIKELY).mean():.0%} | "
        f"{(said[~jumping] > LIKELY).mean():.2%} | {within:.0%}"
    )


def speed_rows(folder: Path) -> Iterator[str]:
    """Yield the processor time of a rollout, ms a step and sequence, on one thread."""
    data = Episodes.of_dataset(read_dataset(folder / "dataset").of_split("test"))
    run = load_model(PRETRAINED)
    assert isinstance(run, CausalPredictor)
    for count, repeats in ((1, 5), (256, 1)):
        few = data.select(np.arange(count) % len(data))
        run.rollout_forward(few)  # prepares the patients
        start = time.process_time()
        for _ in range(repeats):
            for kept in (run.wires.fits, run.wires.known, run.wires.courses):
                kept.clear()
            run.rollout_forward(few)
        spent = 1e3 * (time.process_time() - start) / (repeats * count * few.samples)
        yield f"| {count} | {spent:.3f} |"


def result_rows(folder: Path) -> Iterator[str]:
    """Yield the rows of the evaluations that are there: P1 to P4 of every model, and the baselines."""
    for path in sorted(folder.glob("evaluation*/metrics.json")):
        model = path.parent.name.removeprefix("evaluation-").removeprefix("evaluation") or "causal"
        for split, result in read_json(path)["splits"].items():
            for series, figures in result["tip"].items():
                if model != "causal" and not series.startswith("P"):
                    continue  # the baselines are the same
                spans = ("0-10", "10-30", "30-45")
                cells = [
                    " ".join(
                        f"{figures[name][span]['mae']:.3f} ({figures[name][span]['median']:.3f})" for span in spans
                    )
                    for name in ("abscissa", "offset")
                ]
                skills = (
                    " ".join(
                        f"{(figures[name]['all'].get('skill') or {}).get('hold_slack') or float('nan'):.2f}"
                        for name in ("abscissa", "offset")
                    )
                    if series == "P1"
                    else "–"
                )
                off_wall = figures["offset_off_wall"]["mae"]
                yield f"| {model} | {split} | {series} | {cells[0]} | {cells[1]} | {off_wall:.3f} | {skills} |"


def depth_rows(folder: Path) -> Iterator[str]:
    """Yield the errors by depth, the worst patient and the share of diverged navigations, on new patients."""
    for path in sorted(folder.glob("evaluation*/metrics.json")):
        model = path.parent.name.removeprefix("evaluation-").removeprefix("evaluation") or "causal"
        result = read_json(path)["splits"]["test"]["tip"]
        for series in ("P1", "hold_slack", "training_mean", "friction_90", "friction_110"):
            if model != "causal" and series != "P1":
                continue  # the baselines are the same
            figures = result[series]
            cells = [
                " ".join(f"{part['mae']:.3f}" for part in figures[name]["by_depth"].values())
                for name in ("abscissa", "offset")
            ]
            worst = figures["worst_anatomy"]["mae"]
            yield f"| {model} | {series} | {cells[0]} | {cells[1]} | {worst:.3f} | {figures['diverged_share']:.0%} |"


def control_rows(folder: Path) -> Iterator[str]:
    """Yield the errors of the controls that every model's IF asks for."""
    for path in sorted(folder.glob("evaluation*/metrics.json")):
        model = path.parent.name.removeprefix("evaluation-").removeprefix("evaluation") or "causal"
        result = read_json(path)["splits"]["test"]["control"]
        for series, figures in result.items():
            if model != "causal" and series != "P2":
                continue  # the baselines are the same
            cells = " | ".join(f"{figures[axis]['rmse']:.2f}" for axis in ("translation_mm_s", "rotation_deg_s"))
            yield f"| {model} | {series} | {cells} |"


def written(text: str, mark: str, rows: list[str]) -> str:
    """Return a page with the rows of one table replaced."""
    pattern = rf"(<!-- {mark}:begin -->\n(?:\|.*\n){{2}})[^<]*(<!-- {mark}:end -->)"
    table = "".join(f"{line}\n" for line in [*rows, "", made_on()])
    return re.sub(pattern, lambda found: found[1] + table + found[2], text)


if __name__ == "__main__":
    torch.set_num_threads(1)
    folder = Path(sys.argv[1])
    page = PAGE.read_text(encoding="utf-8")
    for mark, rows in zip(("headline", "jumps"), p1_rows(folder), strict=True):
        page = written(page, mark, rows)
    if not (folder / "evaluation" / "metrics.json").is_file():
        PAGE.write_text(page, encoding="utf-8")
        sys.exit()
    page = written(page, "speed", list(speed_rows(folder)))
    page = written(page, "results", list(result_rows(folder)))
    page = written(page, "depth", list(depth_rows(folder)))
    page = written(page, "controls", list(control_rows(folder)))
    PAGE.write_text(page, encoding="utf-8")
