"""Many random navigations of many patients, simulated and stored: `generate_dataset`.

One file holds a block of sequences of one anatomy. It is written under a temporary name and renamed when whole, and
everything in it follows from the seed, the anatomy's name and the sequence's index; so a run that was killed goes on
with whole files and ends with the same bits as a run that was not.
"""

from __future__ import annotations

import os
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from endopilot.dataset import parquet, schema
from endopilot.dataset.splits import SPLITS
from endopilot.dataset.study import Block, DatasetConfig, Study, plan_study
from endopilot.dataset.workers import work_here, work_on_cluster
from endopilot.files import manifest, read_json, write_json, writing
from endopilot.progress import progress
from endopilot.runs import claim
from endopilot.simulation.device import Device

_WORK_PATH = "meta/work.json"
"""What the files that are there have cost so far; it goes into the manifest when the dataset is whole."""


def generate_dataset(
    anatomy_folders: Sequence[str | Path],
    output: str | Path,
    device: Device,
    config: DatasetConfig | None = None,
    *,
    scheduler: str | None = None,
) -> None:
    """Simulate random navigations of every anatomy and store them in the LeRobot v3 layout.

    A run that was interrupted goes on where it stopped when it is started again with the same arguments; a finished
    one returns at once.

    Args:
        anatomy_folders: anatomies on disk, with different names.
        output: folder of the dataset.
        device: the wire.
        config: number, length, distribution and split of the navigations; the defaults if not given.
        scheduler: address of a Dask scheduler whose workers simulate; the cores of this machine if not given.

    Raises:
        InputError: too few anatomies for the split, two anatomies of one name, an output folder that holds something
            else or was begun with other settings, a scheduler that cannot be reached, or a full disk.
    """
    config = config or DatasetConfig()
    study = plan_study([Path(folder) for folder in anatomy_folders], Path(output), device, config)
    blocks = study.blocks()
    claim(study.plan.output, "endopilot dataset", **study.settings)
    if _is_finished(study, blocks):
        return
    (study.plan.output / schema.MANIFEST_PATH).unlink(missing_ok=True)
    missing = [block for block in blocks if not schema.paths_of_file(study.plan.output, block.number)[0].exists()]
    samples, to_do = (sum(len(block.sequences) for block in some) * config.samples for some in (blocks, missing))
    with progress("Simulating navigations", total=samples) as advance:
        advance(samples - to_do)
        ledger = _Ledger(study)
        simulated, start = 0, time.perf_counter()

        def tell(amount: int) -> None:
            nonlocal simulated
            simulated += amount
            advance(amount, f"{simulated / (time.perf_counter() - start):,.0f} samples/s")

        def done_there(block: Block, seconds: float) -> None:
            ledger.add(block, seconds)
            tell(len(block.sequences) * config.samples)

        if scheduler is None:
            work_here(study.plan, missing, ledger.add, tell)
        else:
            there = [replace(block, folder=block.folder.resolve()) for block in missing]
            plan = replace(study.plan, output=study.plan.output.resolve())
            work_on_cluster(plan, there, done_there, scheduler)
    _finish(study, blocks)


class _Ledger:
    """Keeps what the files have cost, also over interruptions."""

    def __init__(self, study: Study) -> None:
        self._path, self._samples = study.plan.output / _WORK_PATH, study.plan.config.samples
        self._cost = read_work(study.plan.output)
        self._then = time.perf_counter()

    def add(self, block: Block, processor_seconds: float) -> None:
        now = time.perf_counter()
        self._cost["samples"] += len(block.sequences) * self._samples
        self._cost["processor_seconds"] += processor_seconds
        self._cost["wall_seconds"] += now - self._then
        self._then = now
        write_json(self._path, self._cost)


def read_work(output: Path) -> dict[str, Any]:
    """Return `samples`, and the `processor_seconds` and `wall_seconds` that they took, of an unfinished dataset."""
    path = output / _WORK_PATH
    return read_json(path) if path.exists() else {"samples": 0, "processor_seconds": 0.0, "wall_seconds": 0.0}


def _is_finished(study: Study, blocks: Sequence[Block]) -> bool:
    """Return whether the manifest, which is written last, and all other files are there."""
    output = study.plan.output
    files = [file for block in blocks for file in schema.paths_of_file(output, block.number)]
    described = (schema.INFO_PATH, schema.STATS_PATH, schema.TASKS_PATH, schema.MANIFEST_PATH)
    return all(file.exists() for file in (*files, *(output / name for name in described)))


def _finish(study: Study, blocks: Sequence[Block]) -> None:
    """Write what describes the whole: statistics, task, info, and last the manifest."""
    import pandas as pd  # slow to import, and only needed here

    plan = study.plan
    files = [schema.paths_of_file(plan.output, block.number) for block in blocks]
    columns = ("episode_index", "anatomy", "sequence", "split", "stopped_short", "valid", "invalid_reason")
    episodes = [row for _, path in files for row in parquet.read_table(path, plan.key).select(columns).to_pylist()]
    started = time.process_time()
    with progress("Describing the dataset", total=len(files)) as advance:
        stats, shares = parquet.statistics(plan.config.control, [path for path, _ in files], plan.key, advance)
    work = read_work(plan.output)
    work["processor_seconds"] += time.process_time() - started
    write_json(plan.output / schema.STATS_PATH, stats)
    tasks = pd.DataFrame({"task_index": [0]}, index=pd.Index([schema.TASK], name="task"))
    with writing(plan.output / schema.TASKS_PATH) as partial:
        tasks.to_parquet(partial)
    samples = plan.config.samples
    write_json(plan.output / schema.INFO_PATH, schema.info(plan.config.control, len(episodes), samples))
    told = ("episode_index", "anatomy", "sequence", "invalid_reason")
    invalid = [{name: row[name] for name in told} for row in episodes if not row["valid"]]
    counts = Counter(row["split"] for row in episodes)
    record = manifest(
        config=plan.config,
        seed=plan.config.seed,
        inputs=dict(zip(study.names, study.fingerprints, strict=True)),
        key=plan.key,
        settings=study.settings,
        files=len(files),
        samples_per_episode=samples,
        device=asdict(plan.device),
        anatomies=[_anatomy_record(study, i) for i in range(len(study.names))],
        splits={name: counts[name] for name in SPLITS if counts[name]},
        manoeuvres=shares,
        stopped_short=sum(row["stopped_short"] for row in episodes),
        invalid={"episodes": len(invalid), "which": invalid},
        work=work,
    )
    write_json(plan.output / schema.MANIFEST_PATH, record)
    (plan.output / _WORK_PATH).unlink(missing_ok=True)


def _anatomy_record(study: Study, index: int) -> dict[str, Any]:
    """Return name, folder as seen from the dataset, and fingerprint of an anatomy."""
    folder = os.path.relpath(study.folders[index].resolve(), study.plan.output.resolve())
    return {"name": study.names[index], "folder": folder, "sha256": study.fingerprints[index]}
