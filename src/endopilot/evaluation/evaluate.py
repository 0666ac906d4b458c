"""Roll a trained run out by the protocols P1 to P4, beside their baselines, and measure it: `evaluate`."""

from __future__ import annotations

import time
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from endopilot.anatomy.io import read_anatomy
from endopilot.dataset.loader import Dataset, read_dataset
from endopilot.devices.device import Wire
from endopilot.devices.drive_limits import DriveLimits
from endopilot.devices.robot import DriveMotion, RobotConfig, read_robot
from endopilot.errors import InputError
from endopilot.evaluation.metrics import PAPER_ERRORS
from endopilot.evaluation.results import (
    METRICS_FILE,
    REPLAYED,
    REPORT_FILE,
    RESULTS_FILE,
    SPLIT_TITLES,
    SPLITS,
    SplitResult,
    TipSeries,
    findings,
    generalisation_gap,
    over_seeds,
    summarize,
    tip_series,
    write_results,
)
from endopilot.extras import extra_named
from endopilot.files import manifest, write_json
from endopilot.models.config import WINDOW, WIRES, read_run, run_inputs
from endopilot.models.episodes import Episodes, OpenLoop, Predictor, trained_patients
from endopilot.progress import Advance, progress
from endopilot.runs import claim
from endopilot.settings import Count, Seed, settings
from endopilot.simulation.trajectory import Trajectory
from endopilot.types import Anatomy, VesselTree


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
        from endopilot.models.checkpoint import load_model  # brings torch, slow to import

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
    about = {"robot": robot, "other_seeds": other_seeds, "config": config}
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
    patients = sum(len(np.unique(data.anatomy)) for data in chosen.values())
    with progress("Evaluating", total=(1 + len(PROTOCOLS)) * patients) as advance:
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


Control = Float[np.ndarray, "episodes samples 2"]
Samples = Float[np.ndarray, "episodes samples"]


@dataclass(frozen=True, eq=False)
class Recorded:
    """Recorded episodes, with the anatomies (in the order of their names), the wire, and the robot, if any, that
    controls pass."""

    data: Dataset
    names: tuple[str, ...]
    anatomies: tuple[Anatomy, ...]
    anatomy_of: Int[np.ndarray, "episodes"]
    device: Wire
    robot: RobotConfig | None = None

    @staticmethod
    def of(data: Dataset, robot: RobotConfig | None = None) -> Recorded:
        """Read what the episodes of a dataset were recorded with; InputError if an anatomy is missing or damaged."""
        names, anatomy_of = np.unique(data.anatomy, return_inverse=True)
        anatomies = tuple(read_anatomy(data.anatomy_folder(str(name))) for name in names)
        return Recorded(data, tuple(map(str, names)), anatomies, anatomy_of, data.stack.wire, robot)

    def drivable(self, control: Control) -> Control:
        """Return what a drive makes of controls, within its speed and travel; NaN stays NaN. A robot's drives begin at
        rest, in the middle of their play, after the given states."""
        driven, inserted = np.empty(control.shape), self.data.inserted_length[:, WINDOW - 1, 0].astype(float)
        for index, anatomy in enumerate(self.anatomies):
            mine, limits = self.anatomy_of == index, DriveLimits.of(self.device, anatomy)
            driven[mine] = limits.clip_sequence(control[mine], inserted[mine], self.data.sample_period_s)
            if self.robot is not None:
                driven[mine] = self._by_robot(self.robot, driven[mine], np.flatnonzero(mine), limits)
        return driven

    def _by_robot(
        self, robot: RobotConfig, control: Control, episodes: Int[np.ndarray, "episodes"], limits: DriveLimits
    ) -> Control:
        """Return what a robot makes of controls; each episode has one of its own."""
        held = (self.data.inserted_length, self.data.rotation)
        start = np.stack([each[episodes, WINDOW - 1, :1] for each in held], axis=-1).astype(float)
        seeds = [(int(self.data.sequence[each]), 7) for each in episodes]
        motion = DriveMotion(robot, [[limits]] * len(episodes), start, seeds=seeds)
        made, period = np.empty_like(control), self.data.sample_period_s
        for sample in range(control.shape[1]):
            motion.command(np.nan_to_num(control[:, sample, None]))
            made[:, sample] = motion.advance(period)[:, 0] / period
        lost = ~np.isfinite(control).all(axis=-1).cumprod(axis=1).astype(bool)
        made[lost] = np.nan
        return made

    def simulated(
        self, controls: Mapping[str, Control], advance: Advance | None = None
    ) -> Iterator[tuple[Int[np.ndarray, "chosen"], Trajectory]]:
        """Yield the episodes of one anatomy and their simulation, a world for each series and episode, series by
        series: driven as they were while states are given, then the wire by each series, catheters as commanded. Series
        of `REPLAYED` with another friction have it from the start."""
        for index, anatomy in enumerate(self.anatomies):
            mine = np.flatnonzero(self.anatomy_of == index)
            worlds = self.data[np.tile(mine, len(controls))]
            after = np.concatenate([control[mine] for control in controls.values()])
            driven = worlds.command[:, : WINDOW + after.shape[1]].astype(float)
            driven[:, WINDOW:, 0] = np.nan_to_num(after)
            friction = np.concatenate([REPLAYED.get(name, 1.0) * self.data.friction[mine] for name in controls])
            yield mine, worlds.driven(driven, anatomy=anatomy, friction=friction)
            if advance:
                advance(1, anatomy.name)


def replay(
    recorded: Recorded, controls: Mapping[str, Control], advance: Advance
) -> dict[str, tuple[TipSeries, Samples]]:
    """Simulate every episode again with each series of controls (mm/s, rad/s) after the given states.

    Returns:
        Of each series where the tip went, and its distance from the recorded one, mm; NaN from where the simulation
        fails, or there is no finite control.
    """
    out = {name: np.full((4, *recorded.data.valid[:, WINDOW:].shape), np.nan) for name in controls}
    for chosen, rollout in recorded.simulated(controls, advance):
        commanded = np.concatenate([control[chosen] for control in controls.values()])
        usable = rollout.valid[:, WINDOW:] & np.isfinite(commanded).all(axis=-1).cumprod(axis=1).astype(bool)
        true_tip, tip = recorded.data.tip_position[np.tile(chosen, len(controls))], rollout.tip
        distance = np.linalg.norm(rollout.tip_position - true_tip, axis=-1)
        signals = np.stack([tip.abscissa, tip.offset, tip.radius, distance])[:, :, WINDOW:, 0]
        parts = np.split(np.where(usable, signals, np.nan), len(controls), axis=1)
        for name, part in zip(controls, parts, strict=True):
            out[name][:, chosen] = part
    return {name: (TipSeries(*parts[:3]), parts[3]) for name, parts in out.items()}


def hold_slack(data: Dataset) -> Control:
    """Return (Δtip, γtip), mm, if the slack Δ − Δtip and the offset stay as in the last given state."""
    slack = data.inserted_length[:, WINDOW - 1, 0] - data.tip_abscissa[:, WINDOW - 1, 0]
    abscissa = data.inserted_length[:, WINDOW:, 0] - slack[:, None]
    offset = np.broadcast_to(data.tip_offset[:, WINDOW - 1, :1], abscissa.shape)
    return np.stack([abscissa, offset], axis=-1).astype(float)


def baselines(data: Dataset, training: Dataset | None) -> tuple[dict[str, Control], dict[str, Control]]:
    """Return what simple guesses have the tip do (Δtip, γtip, mm), and the controls (mm/s, rad/s) that they choose.

    Slack and offset, or the control, stay as in the last given state; the drive moves as far as the tip is to move,
    without rotation; or slack, offset and control are the means over the training episodes, if any.
    """
    last = np.repeat(data.control[:, WINDOW - 1, :1], data.control.shape[1] - WINDOW, axis=1).astype(float)
    travel = np.diff(data.tip_abscissa[:, WINDOW - 1 :, 0].astype(float), axis=1)
    follow = np.stack([travel / data.sample_period_s, np.zeros_like(travel)], axis=-1)
    tips, controls = {"hold_slack": hold_slack(data)}, {"hold_control": last, "follow_slack": follow}
    if training is not None:
        slack = np.mean((training.inserted_length - training.tip_abscissa)[:, :, 0], dtype=float)
        abscissa = data.inserted_length[:, WINDOW:, 0] - slack
        offset = np.full(abscissa.shape, np.mean(training.tip_offset[:, :, 0], dtype=float))
        tips["training_mean"] = np.stack([abscissa, offset], axis=-1)
        mean = training.control[:, :, 0].mean(axis=(0, 1), dtype=float)
        controls["training_mean"] = np.broadcast_to(mean, last.shape).copy()
    return tips, controls


PROTOCOLS = ("forward", "inverse", "dual")  # what a predictor does with the episodes of each patient


def run_protocols(
    predictor: Predictor, data: Dataset, training: Dataset | None, advance: Advance, robot: RobotConfig | None = None
) -> SplitResult:
    """Predict the samples after the 30 given states by every protocol, and simulate the controls that were chosen.

    P1 is the forward network under the true controls; P2 the inverse network with the true tip as desired; P3 the
    paper's loop of both; P4 the controls of P3 simulated again from the episode's start, as it was recorded, within the
    limits of the drive, or after `robot`. Baselines that are means are over `training`, if any. `advance` is called
    with P1's error and each anatomy's simulation.
    """
    recorded = Recorded.of(data, robot)
    predicted = _predicted(predictor, Episodes.of_dataset(data), recorded.anatomy_of, advance)
    predicted_tips, controls = baselines(data, training)
    predicted_tips = {"P1": predicted["forward"].tip, "P3": predicted["dual"].tip} | predicted_tips
    controls = {"P2": predicted["inverse"].control, "P3": predicted["dual"].control} | controls
    trees = [anatomy.tree for anatomy in recorded.anatomies]
    tips = {
        name: _series(tip, trees, recorded.anatomy_of, data.branch[:, :, 0]) for name, tip in predicted_tips.items()
    }
    replayed = {"P4": "P3", "P2_replayed": "P2", "hold_control": "hold_control", "follow_slack": "follow_slack"}
    driven = {name: recorded.drivable(controls[source]) for name, source in replayed.items()}
    replays = replay(recorded, driven | dict.fromkeys(REPLAYED, data.command[:, WINDOW:, 0]), advance)
    true = (data.tip_abscissa, data.tip_offset, data.lumen_radius)
    return SplitResult(
        sample_period_s=data.sample_period_s,
        anatomies=recorded.names,
        anatomy=recorded.anatomy_of,
        sequence=data.sequence,
        wire_radius_mm=recorded.device.tip_radius_mm,
        true=TipSeries(*(values[:, WINDOW:, 0].astype(float) for values in true)),
        true_control=data.control[:, WINDOW:, 0].astype(float),
        tips=tips | {name: tip for name, (tip, _) in replays.items()},
        controls=controls,
        tip_distance={name: distance for name, (_, distance) in replays.items()},
    )


def _predicted(
    predictor: Predictor, episodes: Episodes, anatomy_of: Int[np.ndarray, "episodes"], advance: Advance
) -> dict[str, OpenLoop]:
    """Return a predictor's answers by each protocol, an anatomy at a time: a slow model shows its errors early."""
    order = np.argsort(anatomy_of, kind="stable")
    parts = [
        episodes.select(chosen) for chosen in np.split(order, np.unique(anatomy_of[order], return_index=True)[1][1:])
    ]
    found, errors = {}, []
    for protocol in PROTOCOLS:
        rollouts = []
        for part in parts:
            rollouts.append(getattr(predictor, f"rollout_{protocol}")(part))
            if protocol == "forward":
                errors.append(np.abs(rollouts[-1].tip[..., 0] - part.tip[:, WINDOW:, 0]).mean())
            patients = "patient" if len(errors) == 1 else "patients"
            advance(1, f"{protocol}; P1: Δtip errs by {np.nanmean(errors):.3f} mm in {len(errors)} {patients}")
        back = np.argsort(order)
        signals = ([getattr(rollout, name) for rollout in rollouts] for name in ("tip", "control"))
        found[protocol] = OpenLoop(*(np.concatenate(signal)[back] for signal in signals))
    return found


def _series(
    tip: Float[np.ndarray, "episodes samples 2"],
    trees: Sequence[VesselTree],
    anatomy_of: Int[np.ndarray, "episodes"],
    branch: Int[np.ndarray, "episodes all_samples"],
) -> TipSeries:
    """Return a predicted tip with the lumen's radius at its abscissa in the branch that the true tip is in."""
    abscissa, offset = (np.where(np.isfinite(tip).all(axis=-1), tip[..., i], np.nan) for i in range(2))
    radius = np.full(abscissa.shape, np.nan)
    branch = branch[:, WINDOW:]
    for index, tree in enumerate(trees):
        for into in np.unique(branch[anatomy_of == index]):
            here = (anatomy_of == index)[:, None] & (branch == into)
            line = tree.path(int(into))
            radius[here] = np.interp(abscissa[here], line.abscissa, line.radius)
    return TipSeries(abscissa, offset, radius)
