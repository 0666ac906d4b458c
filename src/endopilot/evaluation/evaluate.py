"""Roll a trained run out by the protocols P1 to P4 and measure it: `evaluate`."""

from __future__ import annotations

import time
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from endopilot import __version__
from endopilot.dataset.loader import Dataset, read_dataset
from endopilot.devices.robot import read_robot
from endopilot.errors import InputError
from endopilot.evaluation.metrics import PAPER_ERRORS
from endopilot.evaluation.results import (
    METRICS_FILE,
    REPORT_FILE,
    RESULTS_FILE,
    SPLIT_TITLES,
    SPLITS,
    SplitResult,
    findings,
    generalisation_gap,
    over_seeds,
    summarize,
    tip_series,
    write_results,
)
from endopilot.extras import extra_named
from endopilot.files import manifest, write_json
from endopilot.models.config import WIRES, read_run, run_inputs
from endopilot.models.episodes import trained_patients
from endopilot.progress import progress
from endopilot.runs import claim
from endopilot.settings import Count, Seed, settings


@settings
class EvaluateConfig:
    """How much is evaluated."""

    sequences: Count | None = None
    """Navigations of each split that are evaluated, spread evenly over its patients; all if not given."""
    seed: Seed = 0
    """Seed of the bootstrap that gives the intervals over patients."""
    robot: str | None = None
    """Name of a robot (docs/concepts/robot.md) or a YAML file: the controls of P4 pass its drives before they move the
    wire. If not given, they move it as they are."""


def evaluate(
    run: str | Path,
    *,
    output: str | Path,
    config: EvaluateConfig | None = None,
    dataset: str | Path | None = None,
    other_seeds: Sequence[str | Path] = (),
) -> dict[str, Any]:
    """Evaluate a run on navigations and on patients that it was not trained on.

    Every navigation of a new patient counts, as the split "test"; of patients that the run was trained on, those
    outside the split "train", as "seen_test". The baseline "training mean" is over the split "train" of the latter, and
    left out where there is none. Writes `evaluation.npz` (the predictions) and `metrics.json` (every number, and how it
    was made), each whole or not at all, and returns the latter's content.

    Args:
        run: made by `endopilot train`, or "wires", the simulated wires.
        output: where the result goes.
        config: how much is evaluated.
        dataset: folder of the dataset to evaluate on; the one that the run was trained on if not given.
        other_seeds: runs of the same training with other seeds, whose errors in P1 shall stand beside the run's.

    Raises:
        InputError: the run, its dataset or an anatomy is missing or damaged, nothing was held out, the dataset has
            another wire, another seed other patients, there is no such robot, or the output belongs to another run.
    """
    with extra_named("evaluate"):
        from endopilot.evaluation.protocols import count_steps, run_protocols  # brings torch, slow to import
        from endopilot.models.checkpoint import load_model
        from endopilot.models.episodes import Episodes

    config = config or EvaluateConfig()
    robot = None if config.robot is None else read_robot(config.robot)
    start, run_folder, output = time.perf_counter(), Path(run), Path(output)
    other_seeds = [Path(run) for run in other_seeds]
    whole = read_dataset(Path(dataset or _own_dataset(run_folder, read_run(run_folder))).resolve())
    known = trained_patients(run_folder, read_run(run_folder), whole)
    for other in other_seeds:
        if trained_patients(other, read_run(other), whole) != known:
            raise InputError(f"{other}: was trained on other patients than {run_folder}; give runs of one training")
    inputs = run_inputs(run_folder) | {"dataset": whole.manifest["key"]}
    about = {"robot": robot, "other_seeds": other_seeds, "config": config, "version": __version__}
    claim(output, "endopilot evaluate", inputs=inputs, **about)
    predictor, others = load_model(run_folder), [load_model(other) for other in other_seeds]
    held_out, training = _parted(whole, known)
    if not held_out:
        raise InputError(
            f"{whole.folder}: {run_folder} was trained on all its navigations; "
            "make it with seen_test_share above 0 or with more patients"
        )
    chosen = {split: _chosen(data, config.sequences) for split, data in held_out.items()}
    results: dict[str, SplitResult] = {}
    steps = sum(count_steps(data) for data in chosen.values())
    with progress("Evaluating", total=steps) as advance:
        for split, data in chosen.items():
            results[split] = run_protocols(predictor, data, training, advance, robot)
    metrics = _metrics(results, known, config.seed) | {
        "run": str(run_folder),
        "dataset": str(whole.folder),
        "robot": None if robot is None else asdict(robot),
        "training_mean": None
        if training is None
        else {"navigations": len(training), "patients": len(set(training.anatomy.tolist()))},
        "manifest": manifest(config=config, seed=config.seed, inputs=inputs, wall_seconds=time.perf_counter() - start),
    }
    for split, data in chosen.items() if others else ():
        episodes = Episodes.of_dataset(data)
        tips = [results[split].tips["P1"], *(tip_series(other.rollout_forward(episodes).tip) for other in others)]
        runs = [str(run_folder), *map(str, other_seeds)]
        metrics["splits"][split]["seeds"] = {"runs": runs, "P1": over_seeds(results[split], tips)}
    for name in (REPORT_FILE, METRICS_FILE):
        (output / name).unlink(missing_ok=True)
    write_results(results, output / RESULTS_FILE)
    write_json(output / METRICS_FILE, metrics)
    return metrics


def _parted(dataset: Dataset, known: Collection[str]) -> tuple[dict[str, Dataset], Dataset | None]:
    """Return the valid navigations that a run was not trained on, by split of the result, and those that it was."""
    valid, of_known = dataset.valid.all(axis=1), np.isin(dataset.anatomy, sorted(known))
    trained = of_known & (dataset.split == "train")
    masks = dict(zip(SPLITS, (valid & of_known & ~trained, valid & ~of_known), strict=True))
    held_out = {split: dataset[mask] for split, mask in masks.items() if mask.any()}
    return held_out, dataset[valid & trained] if (valid & trained).any() else None


def _chosen(data: Dataset, sequences: int | None) -> Dataset:
    if sequences is None or sequences >= len(data):
        return data
    rank = np.empty(len(data), dtype=int)
    for name in np.unique(data.anatomy):
        of_anatomy = np.flatnonzero(data.anatomy == name)
        rank[of_anatomy] = np.arange(len(of_anatomy))
    return data[np.sort(np.lexsort((data.anatomy, rank))[:sequences])]


def _own_dataset(run: Path, record: Mapping[str, Any]) -> Path:
    if str(run) == WIRES:
        raise InputError(f"{run}: simulated wires are trained on no dataset; name one with --dataset")
    own = Path(run) / record["dataset"]
    if not own.is_dir():
        raise InputError(f"{own}: the dataset that the run was trained on is not here; name one with --dataset")
    return own


def _metrics(results: Mapping[str, SplitResult], known: Collection[str], seed: int) -> dict[str, Any]:
    splits = {
        split: {"title": SPLIT_TITLES[split], "known_patients": len(set(result.anatomies) & set(known))}
        | summarize(result, seed=seed)
        for split, result in results.items()
    }
    metrics: dict[str, Any] = {
        "unit": "mm where no other stands",
        "sample_period_s": next(iter(results.values())).sample_period_s,
        "paper": PAPER_ERRORS,
        "splits": splits,
    }
    gap = generalisation_gap(splits)
    metrics |= {"generalisation_gap": gap} if gap else {}
    return metrics | {"findings": findings(metrics)}
