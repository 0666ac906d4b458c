"""Measure what was tried for the causal model, and write the tables of docs/learning.md.

`python docs/figures/learning.py FOLDER`: FOLDER holds the dataset and the evaluations that the page's commands make;
what is not there is left out. `--tried` trains the variants too, some minutes each on one core, on the split
`calibrate`; without it their table stays as it is.
"""

from __future__ import annotations

import math
import re
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from endopilot.dataset.loader import Dataset, load_dataset
from endopilot.evaluation.baselines import hold_slack
from endopilot.evaluation.metrics import OFF_WALL_MM
from endopilot.files import read_json
from endopilot.models import play
from endopilot.models.causal import CausalNetwork
from endopilot.models.config import WINDOW, CausalConfig
from endopilot.models.rollout import load_run
from endopilot.models.sequences import N_INPUTS, Sequences, read_vessels, unfold
from endopilot.simulation.device import read_device

PAGE = Path(__file__).parents[1] / "learning.md"
RUNS = {"`pretrained`, seed 0": "seed-0", "seed 1": "seed-1", "seed 2": "seed-2", "`paper`": "paper"}
"""Runs of `make recipe-laptop`, by the name of the row."""
OURS = next(iter(RUNS))
RADIUS_MM = read_device("workhorse-014").tip_radius_mm
SPANS = ((30, 50), (50, 90), (90, 120))
PATIENTS, EPOCHS, BATCH, RATE = 60, 3, 32, 2e-3
ENVELOPES = np.r_[2:8, 11:27]
"""Columns that come from the envelopes or the play operator."""
VESSEL = np.arange(play.N_FEATURES - 4 * len(play.WINDOW_MM) - 3, play.N_FEATURES)
TURNS = np.array([6, 7]) + len(play.PARTIAL_PLAYS)
SEEN = np.arange(play.N_FEATURES, N_INPUTS)
VARIANTS: dict[str, np.ndarray] = {
    "all": np.array([], dtype=int),
    "without the vessel's geometry": VESSEL,
    "without envelopes and play among the inputs": ENVELOPES,
    "without what was seen a sample ago": SEEN,
}
"""What a network is not told, by the name of the row."""


def row(name: str, off: np.ndarray) -> str:
    """Return a row of a table: mean and median of both errors over the three spans, mm."""
    cells = [
        " ".join(f"{off[:, a:b, i].mean():.3f} ({np.median(off[:, a:b, i]):.3f})" for a, b in SPANS) for i in (0, 1)
    ]
    return f"| {name} | {cells[0]} | {cells[1]} |"


def play_rows(data: Dataset) -> Iterator[str]:
    """Yield what the play operator does alone, as it is and with variations."""
    vessels, patient = read_vessels(data), np.unique(data.anatomy, return_inverse=True)[1]
    seen = np.broadcast_to(np.arange(data.valid.shape[1]) < WINDOW, data.valid.shape)
    truth = np.stack([data.tip_abscissa, data.tip_offset], axis=-1).astype(float)
    held = np.abs(hold_slack(data, WINDOW) - truth[:, WINDOW:])
    yield row("hold slack and offset", np.pad(held, ((0, 0), (WINDOW, 0), (0, 0))))

    def guessed(episodes: Dataset) -> np.ndarray:
        return np.abs(unfold("forward", vessels, patient, episodes, seen).guess - truth)

    yield row("play operator, nothing learned", guessed(data))
    yield row(
        "play operator, the tip's rotation lags by up to 0.003 rad a mm",
        guessed(replace(data, rotation=_lagging(data))),
    )
    before = play._SHARPNESS
    for sharpness in (4.0, 80.0):
        play._SHARPNESS = sharpness
        yield row(f"play operator, nominal wires mixed with a concentration of {sharpness:g}", guessed(data))
    play._SHARPNESS = before


def _lagging(data: Dataset) -> np.ndarray:
    """Return the rotation of a tip that follows the drive's with a play that grows with the inserted length, rad."""
    angle, out = data.initial_rotation.astype(float), np.empty(data.rotation.shape)
    for t in range(out.shape[1]):
        room = 0.003 * data.inserted_length[:, t]
        angle = np.clip(angle, data.rotation[:, t] - room, data.rotation[:, t] + room)
        out[:, t] = angle
    return out


def variant_rows(training: Dataset, held_out: Dataset) -> Iterator[str]:
    """Yield what short trainings reach, each without some of the inputs, another size or other data."""
    names = np.unique(training.anatomy)
    few = training.select(np.isin(training.anatomy, names[:PATIENTS]))
    fewer = training.select(np.isin(training.anatomy, names[: PATIENTS // 3]))
    test = Sequences.of(held_out, read_vessels(held_out), ("ff",), 0)
    made = Sequences.of(few, read_vessels(few), ("ff",), 0)
    for name, hidden in VARIANTS.items():
        yield row(f"network: {name}", _trained(made, test, CausalConfig(), hidden))
    yield row("network: half as wide", _trained(made, test, CausalConfig(width=48), VARIANTS["all"]))
    made = Sequences.of(fewer, read_vessels(fewer), ("ff",), 0)
    yield row(
        "network: a third of the patients, as many steps", _trained(made, test, CausalConfig(), VARIANTS["all"], 3)
    )


def _trained(made: Sequences, test: Sequences, size: CausalConfig, hidden: np.ndarray, longer: int = 1) -> np.ndarray:
    """Return the errors on held-out patients after a short training."""
    torch.manual_seed(0)
    network = CausalNetwork(size)
    keep = torch.ones(N_INPUTS)
    keep[hidden] = 0.0
    network.fit_scales(made.inputs["ff"][:, 0] * keep, made.change["ff"][:, 0])
    optimizer, targets = torch.optim.Adam(network.parameters()), made.targets()
    steps = longer * EPOCHS * (len(targets) // BATCH)
    for step in range(steps):
        if step % (len(targets) // BATCH) == 0:
            order = torch.randperm(len(targets))
        at = step % (len(targets) // BATCH)
        inputs, change = made.window("ff", targets[order[at * BATCH : (at + 1) * BATCH]])
        loss = network.loss(network(inputs * keep), change)
        optimizer.param_groups[0]["lr"] = RATE * min(1, (step + 1) / 50) * 0.5 * (1 + math.cos(math.pi * step / steps))
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimizer.step()
    with torch.inference_mode():
        answer = network.eval()(test.inputs["ff"][:, 0] * keep)
    return (answer[..., :2] - test.change["ff"][:, 0]).abs().numpy()


def headline_rows(folder: Path) -> Iterator[str]:
    """Yield P1 on all navigations of the new patients: every run that is there, the play operator, the held slack."""
    data = load_dataset(folder / "dataset").of_split("test")
    truth = np.stack([data.tip_abscissa, data.tip_offset], axis=-1)[:, WINDOW:].astype(float)
    clear = (data.lumen_radius - data.tip_offset)[:, WINDOW:] - RADIUS_MM > OFF_WALL_MM
    vessels, patient = read_vessels(data), np.unique(data.anatomy, return_inverse=True)[1]
    seen = np.broadcast_to(np.arange(data.valid.shape[1]) < WINDOW, data.valid.shape)
    played = unfold("forward", vessels, patient, data, seen)
    there = {name: folder / run for name, run in RUNS.items() if (folder / run / "manifest.json").is_file()}
    tips = {name: load_run(run).rollout_forward(data).tip for name, run in there.items()}
    tips |= {"play operator alone": played.guess[:, WINDOW:], "hold slack and offset": hold_slack(data, WINDOW)}
    held = np.sqrt(((tips["hold slack and offset"] - truth) ** 2).mean(axis=(0, 1)))
    for name, tip in tips.items():
        off = np.abs(tip - truth)
        skills = 1 - np.sqrt((off**2).mean(axis=(0, 1))) / held
        told = row(name, np.pad(off, ((0, 0), (WINDOW, 0), (0, 0))))
        yield f"{told} {off[clear][:, 1].mean():.3f} | {skills[0]:.2f} {skills[1]:.2f} |"
    ours = np.abs(tips[OURS] - truth)
    right = (played.branch == data.branch)[:, WINDOW:]
    few = ours[..., 0] < np.quantile(ours[..., 0], 0.95)
    yield (
        f"| `pretrained`, samples in the branch that it believes ({right.mean():.0%}) | "
        f"all {ours[right][:, 0].mean():.3f} | all {ours[right][:, 1].mean():.3f} | | |"
    )
    spread = load_run(folder / RUNS[OURS]).foretell(data, seen[0]).spread[:, WINDOW:]
    within = (ours < spread).mean(axis=(0, 1))
    yield (
        f"| `pretrained`, share of errors within one spread (76 % of a Laplace distribution) | "
        f"{within[0]:.0%} | {within[1]:.0%} | | |"
    )
    yield (
        f"| `pretrained`, without the worst 5 % of Δtip | all {ours[few][:, 0].mean():.3f} | "
        f"all {ours[few][:, 1].mean():.3f} | | |"
    )


def speed_rows(folder: Path) -> Iterator[str]:
    """Yield the processor time of a rollout, ms a step and sequence, on one thread."""
    data, run = load_dataset(folder / "dataset").of_split("test"), load_run(folder / RUNS[OURS])
    for count, repeats in ((1, 5), (256, 1)):
        few = data.select(np.arange(count) % len(data))
        run.rollout_forward(few)  # reads the patients
        start = time.process_time()
        for _ in range(repeats):
            run.rollout_forward(few)
        spent = 1e3 * (time.process_time() - start) / (repeats * count * few.valid.shape[1])
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


def event_rows(folder: Path) -> Iterator[str]:
    """Yield the share of the samples in which the recorded tip sticks, slips or whips."""
    for split, result in read_json(folder / "evaluation" / "metrics.json")["splits"].items():
        shares = " | ".join(f"{result['event_shares'][name]:.2%}" for name in ("stick", "slip", "whip"))
        yield f"| {split} | {shares} |"


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
    pattern = rf"(<!-- {mark}:begin -->\n(?:\|.*\n){{2}})(?:\|.*\n)*(<!-- {mark}:end -->)"
    return re.sub(pattern, lambda found: found[1] + "".join(f"{line}\n" for line in rows) + found[2], text)


if __name__ == "__main__":
    torch.set_num_threads(1)
    folder = Path(sys.argv[1])
    page = PAGE.read_text(encoding="utf-8")
    page = written(page, "headline", list(headline_rows(folder)))
    page = written(page, "speed", list(speed_rows(folder)))
    page = written(page, "results", list(result_rows(folder)))
    page = written(page, "depth", list(depth_rows(folder)))
    page = written(page, "events", list(event_rows(folder)))
    page = written(page, "controls", list(control_rows(folder)))
    if "--tried" in sys.argv:
        data = load_dataset(folder / "dataset")
        held_out = data.of_split("calibrate")
        page = written(page, "tried", [*play_rows(held_out), *variant_rows(data.of_split("train"), held_out)])
    PAGE.write_text(page, encoding="utf-8")
