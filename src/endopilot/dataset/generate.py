"""Many random navigations of many patients, simulated and stored on this machine's cores or by a Dask cluster. One file
holds a block of sequences of one anatomy, renamed when whole; all follows from the seed, the anatomy's name and the
index, so a killed run goes on to the same bits."""

from __future__ import annotations

import os
import threading
import time
import warnings
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import asdict, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import Bool

from endopilot.anatomy.io import read_anatomy
from endopilot.dataset import parquet, schema
from endopilot.dataset.config import DatasetConfig
from endopilot.dataset.layout import SPLITS, Block, Layout, make_layout, version
from endopilot.dataset.navigations import Draw, draw_navigations, simulate_navigations, stacks_with_tips
from endopilot.devices.device import Wire
from endopilot.devices.robot import RobotConfig
from endopilot.devices.stack import Stack, column_prefixes
from endopilot.errors import InputError
from endopilot.files import manifest, read_json, write_json, write_whole
from endopilot.parallel import CORES
from endopilot.progress import progress
from endopilot.runs import claim, remove_partial_files
from endopilot.simulation.robots import in_grip
from endopilot.simulation.trajectory import SimulationSetUp, Trajectory
from endopilot.simulation.world import World
from endopilot.types import Anatomy


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
    claim(layout.output, "endopilot dataset", **layout.settings)
    described = [layout.output / name for name in schema.DESCRIPTION]  # the manifest last
    missing = [block for block in blocks if not all(map(_is_whole, schema.paths_of_file(layout.output, block.number)))]
    if not missing and all(map(_is_whole, described)):
        return
    described[-1].unlink(missing_ok=True)
    work = {"samples": 0, "processor_seconds": 0.0, "wall_seconds": 0.0}  # of this run, which others began perhaps
    samples, to_do = (sum(len(block.sequences) for block in some) * config.samples for some in (blocks, missing))
    with progress("Simulating navigations", total=samples) as advance:
        advance(samples - to_do)
        simulated, start = 0, time.perf_counter()

        def report(amount: int) -> None:
            nonlocal simulated
            simulated += amount
            advance(amount, f"{simulated / (time.perf_counter() - start):,.0f} samples/s")

        def done(block: Block, seconds: float) -> None:
            work["samples"] += len(block.sequences) * config.samples
            work["processor_seconds"] += seconds
            if scheduler is not None:
                report(len(block.sequences) * config.samples)

        if scheduler is None:
            run_locally(layout, missing, done, report)
        else:
            run_on_cluster(partial(write_block, layout), missing, done, scheduler)
        work["wall_seconds"] = time.perf_counter() - start
    describe(layout, blocks, work)


def _is_whole(file: Path) -> bool:
    """Return whether a file of a dataset is there to its end, where JSON closes and Parquet has its schema."""
    try:
        return bool(pq.read_metadata(file) if file.suffix == ".parquet" else read_json(file))
    except (pa.ArrowInvalid, OSError, InputError):
        return False


def describe(layout: Layout, blocks: Sequence[Block], work: dict[str, Any]) -> None:
    """Write what describes a dataset whose blocks are there: statistics, task, info, and last the manifest, with the
    `work` that the blocks took: `samples`, and their `processor_seconds` and `wall_seconds`."""
    import pandas as pd  # slow to import, and only needed here

    output, config = layout.output, layout.config
    remove_partial_files(output)
    info_path, stats_path, tasks_path, manifest_path = (output / name for name in schema.DESCRIPTION)
    files = [schema.paths_of_file(output, block.number) for block in blocks]
    columns = ("episode_index", "anatomy", "sequence", "split", "stopped_short", "valid", "invalid_reason")
    episodes = parquet.read_tables([path for _, path in files], layout.key).select(columns).to_pylist()
    started = time.process_time()
    described = schema.features(config.control, len(layout.stack), by_robot=layout.robot is not None)
    with progress("Describing the dataset", total=len(files)) as advance:
        stats, shares = parquet.statistics(described, [path for path, _ in files], layout.key, advance)
    work["processor_seconds"] += time.process_time() - started
    write_json(stats_path, stats)
    tasks = pd.DataFrame({"task_index": [0]}, index=pd.Index([layout.task], name="task"))
    write_whole(tasks_path, tasks.to_parquet())
    write_json(info_path, schema.info(described, episodes=len(episodes), samples=len(episodes) * config.samples))
    reported = ("episode_index", "anatomy", "sequence", "invalid_reason")
    invalid = [{name: row[name] for name in reported} for row in episodes if not row["valid"]]
    counts = Counter(row["split"] for row in episodes)
    anatomies = [
        {
            "name": patient.name,
            "folder": os.path.relpath(patient.folder, output),
            "sha256": patient.identity,
            "motion": None if patient.motion is None else asdict(patient.motion),
        }
        for patient in layout.patients
    ]
    record = manifest(
        config=config,
        seed=config.seed,
        inputs={patient.name: patient.identity for patient in layout.patients},
        key=layout.key,
        settings=layout.settings,
        files=len(files),
        samples_per_episode=config.samples,
        device=asdict(layout.stack.wire),
        catheters=[asdict(catheter) for catheter in layout.stack.catheters],
        robot=None if layout.robot is None else asdict(layout.robot),
        world=layout.world.differences(),
        anatomies=anatomies,
        splits={name: counts[name] for name in SPLITS if counts[name]},
        manoeuvres=shares,
        stopped_short=sum(row["stopped_short"] for row in episodes),
        invalid={"episodes": len(invalid), "which": invalid},
        work=work,
    )
    write_json(manifest_path, record)


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
    patients = (layout.patients[0]._replace(motion=set_up.motion),)  # it was not drawn with the seed
    layout = replace(layout, patients=patients)
    (block,) = layout.blocks()
    claim(output, "endopilot navigate", **layout.settings)
    drawn = Draw(
        set_up.initial,
        trajectory.command,
        friction=set_up.friction[:1, 0],
        tip_bend_rad=np.array([stack.wire.tip_bend_rad]),
        tip_stiffness_factor=np.array([tip_stiffness_factor]),
    )
    episodes = _episodes(layout, block, drawn, trajectory, np.array([False]))
    samples = parquet.sample_columns(trajectory, block.first_episode)
    parquet.write_tables(output, block.number, layout.key, episodes=episodes, samples=samples)
    describe(layout, [block], {"samples": 0, "processor_seconds": 0.0, "wall_seconds": 0.0})


def write_block(
    layout: Layout, block: Block, *, threads: int = 1, advance: Callable[[int], None] = lambda _: None
) -> float:
    """Simulate one block and write it; return the processor time that this process took for it, s. `advance` is called
    with the numbers of samples simulated."""
    started = time.process_time()
    config, anatomy, stack = layout.config, _read(block.patient.folder, block.patient.identity), layout.stack
    draw = draw_navigations(config, stack.wire, anatomy, block.sequences, devices=len(stack))
    world = layout.world.drawn(anatomy, config.seed)
    stacks = stacks_with_tips(stack, world, draw.tip_bend_rad, draw.tip_stiffness_factor)
    set_up = SimulationSetUp(
        anatomies=[world.anatomy(anatomy)] * len(stacks),
        stacks=stacks,
        initial=draw.initial,
        friction=world.stack(stack).frictions(draw.friction * world.friction_factor),
        actuation=config.control,
        motion=block.patient.motion,
        config=replace(world.core(config.simulator), threads=threads),
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # invalid worlds are listed in the dataset's manifest
        trajectory, stopped = simulate_navigations(
            set_up,
            draw.control,
            robot=layout.robot,
            ostium_mm=world.ostium_mm,
            seeds=draw.seeds,
            advance=advance,
        )
    episodes = _episodes(layout, block, draw, trajectory, stopped)
    samples = parquet.sample_columns(trajectory, block.first_episode)
    parquet.write_tables(layout.output, block.number, layout.key, episodes=episodes, samples=samples)
    return time.process_time() - started


@lru_cache(maxsize=4)
def _read(folder: Path, identity: str) -> Anatomy:
    """Read an anatomy, kept for the next block; InputError if it is not the one that the dataset was begun with."""
    anatomy = read_anatomy(folder)
    if anatomy.identity != identity:
        raise InputError(f"{folder}: is not the anatomy that the dataset was begun with; restore that anatomy")
    return anatomy


def _episodes(
    layout: Layout, block: Block, draw: Draw, trajectory: Trajectory, stopped: Bool[np.ndarray, "n"]
) -> dict[str, Any]:
    """Return the columns of the episode table; the first seven and the last two are LeRobot's."""
    n, samples = trajectory.valid.shape
    set_up, prefixes = trajectory.set_up, column_prefixes(trajectory.devices)
    whole = [bool(valid.all()) for valid in trajectory.valid]
    episode = block.first_episode + np.arange(n)
    chunk, file = divmod(block.number, schema.FILES_PER_CHUNK)
    return {
        "episode_index": episode,
        "tasks": [[layout.task]] * n,
        "length": np.full(n, samples),
        "dataset_from_index": episode * samples,
        "dataset_to_index": (episode + 1) * samples,
        "data/chunk_index": np.full(n, chunk),
        "data/file_index": np.full(n, file),
        "anatomy": [block.patient.name] * n,
        "anatomy_sha256": [block.patient.identity] * n,
        "sequence": np.array(block.sequences),
        "split": block.splits.tolist(),
        "device": [layout.stack.wire.name] * n,
        "tip_bend_rad": draw.tip_bend_rad,
        "tip_stiffness_factor": draw.tip_stiffness_factor,
        **{f"{prefix}friction": set_up.friction[:, k] for k, prefix in enumerate(prefixes)},
        **{
            f"{prefix}initial_{name}": set_up.initial[:, k, axis]
            for k, prefix in enumerate(prefixes)
            for axis, name in enumerate(("inserted_length_mm", "rotation_rad"))
        },
        **{f"catheter_{k + 1}": [each.name] * n for k, each in enumerate(layout.stack.catheters)},
        "stopped_short": stopped,
        "valid": whole,
        "invalid_reason": ["" if valid else trajectory.why_invalid(world) for world, valid in enumerate(whole)],
        "meta/episodes/chunk_index": np.full(n, chunk),
        "meta/episodes/file_index": np.full(n, file),
    }


Done = Callable[[Block, float], None]  # called with each written block and its processor time, s
Item, Result = TypeVar("Item"), TypeVar("Result")
_CONNECT_TIMEOUT_S = 10  # time limit for a scheduler to answer, s


class _Interrupted(Exception):
    """Ends the threads of an interrupted or failed run."""


def run_locally(layout: Layout, blocks: Sequence[Block], done: Done, advance: Callable[[int], None]) -> None:
    """Write blocks with one thread each, one a core at a time; of fewer blocks the rod core uses the other cores."""
    cores = layout.config.simulator.threads or CORES
    workers = max(1, min(cores, len(blocks)))
    threads = cores // workers
    stop = threading.Event()

    def report(samples: int) -> None:
        if stop.is_set():
            raise _Interrupted
        advance(samples)

    started = time.process_time()
    with ThreadPoolExecutor(workers) as pool:
        futures = {pool.submit(write_block, layout, b, threads=threads, advance=report): b for b in blocks}
        try:
            for future in as_completed(futures):
                future.result()
                now = time.process_time()
                done(futures[future], now - started)
                started = now
        except BaseException:
            stop.set()
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def run_on_cluster(
    work: Callable[[Item], Result], items: Sequence[Item], done: Callable[[Item, Result], None], scheduler: str
) -> None:
    """Do the same work (a module's function, or a `functools.partial` of one) for every item on a Dask cluster's
    workers, which share the folders; a dead one's item goes to another. Raises InputError without `distributed` or a
    scheduler, for another version of endopilot, or where workers keep dying."""
    try:
        import distributed
    except ImportError as error:
        raise InputError("scheduler: needs Dask; install it with pip install 'endopilot[cluster]'") from error
    try:
        client = distributed.Client(scheduler, timeout=_CONNECT_TIMEOUT_S)
    except (OSError, ValueError, TimeoutError) as error:
        raise InputError(
            f"scheduler: {scheduler} cannot be reached; check the address, and that `dask scheduler` runs there"
        ) from error
    with client:
        _check_versions(client, scheduler)
        futures = {client.submit(work, item, pure=False, retries=0): item for item in items}
        try:
            for future in distributed.as_completed(futures):
                done(futures[future], future.result())
        except distributed.KilledWorker as error:
            raise InputError(
                f"scheduler: workers of {scheduler} died over the same file several times; give them more memory"
            ) from error
        except BaseException:
            client.cancel(list(futures))
            raise


def _check_versions(client, scheduler: str) -> None:
    try:
        found = client.run(version)
    except Exception as error:  # of any kind, from the worker
        raise InputError(f"scheduler: a worker of {scheduler} has no endopilot ({error}); install it there") from error
    if not found:
        raise InputError(f"scheduler: {scheduler} has no workers; start some with `dask worker {scheduler}`")
    for worker, other in found.items():
        if other != version():
            raise InputError(f"scheduler: worker {worker} has {other}, here is {version()}; install the same")
