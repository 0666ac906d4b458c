"""Many random navigations of many patients, simulated and stored. One file holds a block of sequences of one anatomy,
renamed when whole; all follows from the seed, the anatomy's name and the index, so a killed run goes on to the same
bits."""

from __future__ import annotations

import os
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from endopilot.dataset import parquet, schema
from endopilot.dataset.config import DatasetConfig
from endopilot.dataset.layout import SPLITS, Block, Layout, make_layout
from endopilot.dataset.navigations import Draw
from endopilot.dataset.workers import run_locally, run_on_cluster, store_block, write_timed
from endopilot.devices.device import Wire
from endopilot.devices.robot import RobotConfig
from endopilot.devices.stack import Stack
from endopilot.errors import InputError
from endopilot.files import manifest, read_json, write_json, writing
from endopilot.progress import progress
from endopilot.runs import claim, remove_partial_files
from endopilot.simulation.robots import in_grip
from endopilot.simulation.trajectory import Trajectory
from endopilot.simulation.world import World

_WORK_PATH = "meta/work.json"  # what the files so far have cost; moves into the manifest in the end


def generate_dataset(
    anatomies: Sequence[str | Path],
    *,
    device: Wire | Stack | str | Path,
    output: str | Path,
    config: DatasetConfig | None = None,
    robot: RobotConfig | None = None,
    world: World | None = None,
    scheduler: str | None = None,
) -> None:
    """Simulate random navigations of every anatomy and store them in the LeRobot v3 layout.

    A run that was interrupted goes on where it stopped when it is started again with the same arguments; a finished
    one returns at once.

    Args:
        anatomies: folders of anatomies with different names.
        device: the wire or its name, or the wire and its catheters; each is driven at random and independently.
        output: folder of the dataset.
        config: number, length, distribution and split of the navigations; the defaults if not given.
        robot: what makes the motions and measures them; if not given, they are made as drawn.
        world: what reality is; its friction, tip and robot come on top of what is drawn and given here.
        scheduler: address of a Dask scheduler whose workers simulate; the cores of this machine if not given.

    Raises:
        InputError: too few anatomies for the split, two anatomies of one name, an output folder that holds something
            else or was begun with other settings, catheters that do not fit around the wire or are to be driven by
            force, or a robot that is, a world that a dataset cannot hold, a scheduler that cannot be reached, or a full
            disk.
    """
    config = config or DatasetConfig()
    folders, stack, world = [Path(folder) for folder in anatomies], Stack.of(device), world or World()
    if robot is not None or world.robot is not None:
        robot = world.real_robot(robot or RobotConfig())
    if robot is not None:
        stack, core = in_grip(stack, robot, config.simulator)
        config = replace(config, simulator=core)
    layout = make_layout(folders, Path(output), stack, config, robot=robot, world=world)
    blocks = layout.blocks()
    claim(layout.context.output, "endopilot dataset", **layout.settings)
    if _is_finished(layout, blocks):
        return
    (layout.context.output / schema.MANIFEST_PATH).unlink(missing_ok=True)
    paths = {block.number: schema.paths_of_file(layout.context.output, block.number) for block in blocks}
    missing = [block for block in blocks if not all(map(_is_whole, paths[block.number]))]
    samples, to_do = (sum(len(block.sequences) for block in some) * config.samples for some in (blocks, missing))
    with progress("Simulating navigations", total=samples) as advance:
        advance(samples - to_do)
        ledger = _Ledger(layout)
        simulated, start = 0, time.perf_counter()

        def report(amount: int) -> None:
            nonlocal simulated
            simulated += amount
            advance(amount, f"{simulated / (time.perf_counter() - start):,.0f} samples/s")

        def done_remotely(block: Block, seconds: float) -> None:
            ledger.add(block, seconds)
            report(len(block.sequences) * config.samples)

        if scheduler is None:
            run_locally(layout.context, missing, ledger.add, report)
        else:
            remote = [replace(block, folder=block.folder.resolve()) for block in missing]
            context = replace(layout.context, output=layout.context.output.resolve())
            run_on_cluster(partial(write_timed, context), remote, done_remotely, scheduler)
    describe(layout, blocks)


class _Ledger:
    def __init__(self, layout: Layout) -> None:
        self._path, self._samples = layout.context.output / _WORK_PATH, layout.context.config.samples
        self._cost = read_work(layout.context.output)
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


def _is_finished(layout: Layout, blocks: Sequence[Block]) -> bool:
    """Return whether the manifest, which is written last, and all other files are there to their ends."""
    output = layout.context.output
    files = [file for block in blocks for file in schema.paths_of_file(output, block.number)]
    described = (schema.INFO_PATH, schema.STATS_PATH, schema.TASKS_PATH, schema.MANIFEST_PATH)
    return all(map(_is_whole, (*files, *(output / name for name in described))))


def _is_whole(file: Path) -> bool:
    """Return whether a file of a dataset is there to its end, where JSON closes and Parquet has its schema."""
    try:
        return bool(pq.read_metadata(file) if file.suffix == ".parquet" else read_json(file))
    except (pa.ArrowInvalid, OSError, InputError):
        return False


def describe(layout: Layout, blocks: Sequence[Block]) -> None:
    """Write what describes a dataset whose blocks are there: statistics, task, info, and last the manifest."""
    import pandas as pd  # slow to import, and only needed here

    context = layout.context
    remove_partial_files(context.output)
    files = [schema.paths_of_file(context.output, block.number) for block in blocks]
    columns = ("episode_index", "anatomy", "sequence", "split", "stopped_short", "valid", "invalid_reason")
    episodes = [row for _, path in files for row in parquet.read_table(path, context.key).select(columns).to_pylist()]
    started = time.process_time()
    described = schema.features(context.config.control, len(context.stack), by_robot=context.robot is not None)
    with progress("Describing the dataset", total=len(files)) as advance:
        stats, shares = parquet.statistics(described, [path for path, _ in files], context.key, advance)
    work = read_work(context.output)
    work["processor_seconds"] += time.process_time() - started
    write_json(context.output / schema.STATS_PATH, stats)
    tasks = pd.DataFrame({"task_index": [0]}, index=pd.Index([context.task], name="task"))
    with writing(context.output / schema.TASKS_PATH) as partial:
        tasks.to_parquet(partial)
    samples = context.config.samples
    info = schema.info(described, episodes=len(episodes), samples=len(episodes) * samples)
    write_json(context.output / schema.INFO_PATH, info)
    reported = ("episode_index", "anatomy", "sequence", "invalid_reason")
    invalid = [{name: row[name] for name in reported} for row in episodes if not row["valid"]]
    counts = Counter(row["split"] for row in episodes)
    where = (os.path.relpath(folder.resolve(), context.output.resolve()) for folder in layout.folders)
    motions = (None if motion is None else asdict(motion) for motion in layout.motions)
    parts = zip(layout.names, where, layout.identities, motions, strict=True)
    anatomies = [dict(zip(("name", "folder", "sha256", "motion"), part, strict=True)) for part in parts]
    record = manifest(
        config=context.config,
        seed=context.config.seed,
        inputs=dict(zip(layout.names, layout.identities, strict=True)),
        key=context.key,
        settings=layout.settings,
        files=len(files),
        samples_per_episode=samples,
        device=asdict(context.stack.wire),
        catheters=[asdict(catheter) for catheter in context.stack.catheters],
        robot=None if context.robot is None else asdict(context.robot),
        world=context.world.differences(),
        anatomies=anatomies,
        splits={name: counts[name] for name in SPLITS if counts[name]},
        manoeuvres=shares,
        stopped_short=sum(row["stopped_short"] for row in episodes),
        invalid={"episodes": len(invalid), "which": invalid},
        work=work,
    )
    write_json(context.output / schema.MANIFEST_PATH, record)
    (context.output / _WORK_PATH).unlink(missing_ok=True)


def write_episode(
    trajectory: Trajectory,
    anatomy_folder: Path,
    output: Path,
    stack: Stack,
    *,
    task: str,
    tip_stiffness_factor: float,
    seed: int,
    origin: Mapping[str, Any],
) -> None:
    """Write a navigation of one world that was recorded every 0.5 s as a dataset of one episode; a wire alone's trains.

    `stack` has the devices as given, whatever their friction and `tip_stiffness_factor` were; `origin` is what else it
    followed from, such as target and policy. Raises InputError where the folder holds something else.
    """
    set_up = trajectory.set_up
    config = DatasetConfig(
        sequences=1,
        seconds=trajectory.valid.shape[1] * trajectory.period_s,
        seed=seed,
        simulator=set_up.config,
        anatomy_shares=(1.0, 0.0, 0.0),
        seen_test_share=0.0,
    )
    moved = {"motion": None if set_up.motion is None else asdict(set_up.motion)}
    layout = make_layout([anatomy_folder], output, stack, config, task=task, origin={**origin, **moved})
    layout = replace(layout, motions=(set_up.motion,))  # it was not drawn with the seed
    (block,) = layout.blocks()
    claim(output, "endopilot navigate", **layout.settings)
    drawn = Draw(
        set_up.initial,
        trajectory.command,
        friction=set_up.friction[:1, 0],
        tip_bend_rad=np.array([stack.wire.tip_bend_rad]),
        tip_stiffness_factor=np.array([tip_stiffness_factor]),
    )
    store_block(layout.context, block, drawn, trajectory, np.array([False]))
    describe(layout, [block])
