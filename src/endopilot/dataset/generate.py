"""Many random navigations of many patients, simulated and stored: `generate_dataset`.

One file holds a block of sequences of one anatomy. It is written under a temporary name and renamed when whole, and
everything in it follows from the seed, the anatomy's name and the sequence's index; so a run that was killed goes on
with whole files and ends with the same bits as a run that was not.
"""

from __future__ import annotations

import hashlib
import json
import os
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Shaped

from endopilot import __version__
from endopilot.anatomy.io import read_anatomy
from endopilot.dataset import schema
from endopilot.dataset.navigate import navigate
from endopilot.dataset.splits import assign_splits
from endopilot.errors import InputError
from endopilot.files import json_text, manifest, read_json, write_json, writing
from endopilot.progress import progress
from endopilot.simulation.controls import ControlConfig, random_controls
from endopilot.simulation.device import Device
from endopilot.simulation.simulator import SimulatorConfig
from endopilot.types import SAMPLE_PERIOD_S, Anatomy, Rollout

FORMAT_VERSION = 1
"""Counts changes of the columns or of their meaning."""


@dataclass(frozen=True, kw_only=True)
class DatasetConfig:
    """How many navigations, how long, how they are driven and how they are split."""

    sequences: int = 1000
    """Random navigations of each anatomy."""
    seconds: float = 60.0
    """Length of a navigation, s; one sample every 0.5 s."""
    seed: int = 0
    """Seed of the random controls and parameters."""
    control: ControlConfig = field(default_factory=ControlConfig)
    """Distribution of the random controls."""
    simulator: SimulatorConfig = field(default_factory=SimulatorConfig)
    """Settings of the rod simulation."""
    friction: tuple[float, float] | None = None
    """Range that each navigation's friction coefficient is drawn from uniformly; the device's own if not given."""
    anatomy_shares: tuple[float, float, float] | None = None
    """Shares of the anatomies that train, calibrate and test; 0.6 0.2 0.2 if not given, and a single anatomy is then
    split by sequence alone."""
    seen_test_share: float = 0.2
    """Share of the navigations of a train anatomy that are held out as the split seen_test."""
    sequences_per_file: int = 250
    """Navigations stored in one file; an interrupted run loses at most one file's work."""

    def __post_init__(self) -> None:
        """Check every field.

        Raises:
            InputError: a field is out of its range.
        """
        for name in ("sequences", "sequences_per_file"):
            if getattr(self, name) < 1:
                raise InputError(f"{name}: {getattr(self, name)} is not positive; give at least 1")
        if self.seed < 0:
            raise InputError(f"seed: {self.seed} is negative; give 0 or more")
        samples = self.seconds / SAMPLE_PERIOD_S
        if not samples >= 1 or samples != int(samples):
            raise InputError(f"seconds: {self.seconds} is not a positive multiple of {SAMPLE_PERIOD_S} s; give e.g. 60")
        if self.friction is not None and not 0 <= self.friction[0] <= self.friction[1]:
            raise InputError(f"friction: {self.friction} is no range; give two numbers, 0 or more, the smaller first")
        shares = self.anatomy_shares
        if shares is not None and not (min(shares) >= 0 and shares[0] > 0 and abs(sum(shares) - 1) < 1e-3):
            raise InputError(f"anatomy_shares: {shares} are not three shares that add up to 1, the first positive")
        if not 0 <= self.seen_test_share < 1:
            raise InputError(f"seen_test_share: {self.seen_test_share} is not in [0, 1); give e.g. 0.2")

    @property
    def samples(self) -> int:
        """Number of samples of a navigation."""
        return round(self.seconds / SAMPLE_PERIOD_S)


@dataclass(frozen=True, eq=False)
class _Block:
    """The sequences of one anatomy that share a file."""

    number: int
    anatomy: int
    sequences: range


@dataclass(frozen=True, eq=False)
class _Plan:
    """Everything that the bits of the dataset follow from."""

    output: Path
    config: DatasetConfig
    device: Device
    folders: tuple[Path, ...]
    names: tuple[str, ...]
    fingerprints: tuple[str, ...]
    splits: Shaped[np.ndarray, "anatomies sequences"]

    @property
    def settings(self) -> dict[str, Any]:
        """What a resumed run must share with the run it continues, as plain JSON values."""
        device, anatomies = asdict(self.device), dict(zip(self.names, self.fingerprints, strict=True))
        return _plain({"config": asdict(self.config), "device": device, "anatomies": anatomies, "version": _version()})

    @property
    def key(self) -> str:
        return hashlib.sha256(json_text(self.settings).encode()).hexdigest()

    def blocks(self) -> Iterator[_Block]:
        number, n, size = 0, self.config.sequences, self.config.sequences_per_file
        for anatomy in range(len(self.names)):
            for first in range(0, n, size):
                yield _Block(number, anatomy, range(first, min(first + size, n)))
                number += 1


def generate_dataset(anatomy_folders: Sequence[Path], output: Path, device: Device, config: DatasetConfig) -> None:
    """Simulate random navigations of every anatomy and store them in the LeRobot v3 layout.

    A run that was interrupted goes on where it stopped when it is started again with the same arguments; a finished
    one returns at once.

    Args:
        anatomy_folders: anatomies on disk, with different names.
        output: folder of the dataset.
        device: the wire.
        config: number, length, distribution and split of the navigations.

    Raises:
        InputError: too few anatomies for the split, two anatomies of one name, an output folder that holds something
            else or was begun with other settings, or a full disk.
    """
    plan = _plan(anatomy_folders, Path(output), device, config)
    if _begin(plan):
        return
    start = time.perf_counter()
    blocks = list(plan.blocks())
    samples_of = [len(block.sequences) * config.samples for block in blocks]
    with progress("Simulating navigations", total=sum(samples_of)) as advance:
        anatomy: Anatomy | None = None
        simulated = 0
        for block, samples in zip(blocks, samples_of, strict=True):
            data_path, _ = schema.paths_of_file(plan.output, block.number)
            if data_path.exists():
                advance(samples)
                continue
            if anatomy is None or anatomy.name != plan.names[block.anatomy]:
                anatomy = read_anatomy(plan.folders[block.anatomy])
            _write_block(plan, block, anatomy)
            simulated += samples
            advance(samples, f"{simulated / (time.perf_counter() - start):,.0f} samples/s")
    _finish(plan, blocks, time.perf_counter() - start)


def _plan(folders: Sequence[Path], output: Path, device: Device, config: DatasetConfig) -> _Plan:
    if not folders:
        raise InputError("anatomies: none given; name at least one folder made by `endopilot anatomy`")
    names, fingerprints = zip(*(_identify(Path(folder)) for folder in folders), strict=True)
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"anatomies: {names.count(name)} are named '{name}'; give each patient a name of its own")
    splits = assign_splits(
        names, config.sequences, anatomy_shares=config.anatomy_shares, seen_test_share=config.seen_test_share
    )
    return _Plan(output, config, device, tuple(map(Path, folders)), names, fingerprints, splits)


def _identify(folder: Path) -> tuple[str, str]:
    """Return an anatomy's name and the SHA-256 of what the simulation depends on."""
    if not (folder / "anatomy.json").exists():
        raise InputError(f"{folder}: holds no anatomy.json, so it is not an anatomy; make one with `endopilot anatomy`")
    record = read_json(folder / "anatomy.json")
    try:
        physical = {key: record[key] for key in ("name", "insertion", "catheter_radius_mm", "sha256")}
    except (KeyError, TypeError) as error:
        raise InputError(f"{folder / 'anatomy.json'}: damaged ({error!r}); make the anatomy again") from error
    return str(record["name"]), hashlib.sha256(json_text(physical).encode()).hexdigest()


def _begin(plan: _Plan) -> bool:
    """Claim the output folder, or check that it was begun with the same settings; return true if it is finished."""
    path = plan.output / schema.MANIFEST_PATH
    if path.exists():
        before = read_json(path)
        for field_name, then, now in _differences(before.get("settings", {}), plan.settings):
            raise InputError(
                f"{plan.output}: was begun with {field_name} = {then}, now it is {now}; "
                "choose another output folder or go back to the first settings"
            )
        files = [file for block in plan.blocks() for file in schema.paths_of_file(plan.output, block.number)]
        if before["complete"] and all(file.exists() for file in files):
            return True
    elif plan.output.exists() and any(plan.output.iterdir()):
        raise InputError(f"{plan.output}: is not empty and holds no dataset; choose another output folder")
    for partial in plan.output.rglob(".part-*"):  # left behind by a process that was killed
        partial.unlink(missing_ok=True)
    write_json(path, {"complete": False, "key": plan.key, "settings": plan.settings})
    return False


def _write_block(plan: _Plan, block: _Block, anatomy: Anatomy) -> None:
    """Simulate one block and write its episodes, then its samples: the sample file says that both are whole."""
    config, sequences = plan.config, block.sequences
    initial, control, friction = _drives(plan, anatomy, sequences)
    rollout, stopped = navigate(anatomy, plan.device, initial, control, friction, config.simulator)
    first_episode = block.anatomy * config.sequences + sequences.start
    data_path, episodes_path = schema.paths_of_file(plan.output, block.number)
    episodes = _episodes(plan, block, rollout, first_episode, friction) | {"stopped_short": stopped}
    for path, table in (
        (episodes_path, schema.episode_table(episodes, plan.key)),
        (data_path, schema.sample_table(rollout, first_episode, plan.key)),
    ):
        with writing(path) as partial:
            partial.write_bytes(schema.parquet_bytes(table))


def _drives(
    plan: _Plan, anatomy: Anatomy, sequences: range
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n samples 2"], Float[np.ndarray, "n"]]:
    """Return initial (Δ, φ), controls and friction of some sequences of an anatomy."""
    config = plan.config
    name_number = int.from_bytes(hashlib.sha256(anatomy.name.encode()).digest()[:8], "little")
    controls_seed, friction_seed = np.random.SeedSequence([config.seed, name_number]).spawn(2)
    initial, control = random_controls(
        config.control,
        n_sequences=config.sequences,
        n_samples=config.samples,
        seed=int(controls_seed.generate_state(1, np.uint64)[0]),
        max_inserted_length_mm=float(anatomy.tree.longest_path().abscissa[-1]),
    )
    if config.friction is None:
        friction = np.full(config.sequences, plan.device.friction)
    else:
        friction = np.random.Generator(np.random.Philox(friction_seed)).uniform(*config.friction, config.sequences)
    chosen = slice(sequences.start, sequences.stop)
    return initial[chosen], control[chosen], friction[chosen]


def _episodes(
    plan: _Plan, block: _Block, rollout: Rollout, first_episode: int, friction: Float[np.ndarray, "n"]
) -> dict[str, Any]:
    """Return the columns of the episode table; the first seven and the last two are LeRobot's."""
    n, samples = rollout.valid.shape
    episode = first_episode + np.arange(n)
    chunk, file = divmod(block.number, schema.FILES_PER_CHUNK)
    return {
        "episode_index": episode,
        "tasks": [[schema.TASK]] * n,
        "length": np.full(n, samples),
        "dataset_from_index": episode * samples,
        "dataset_to_index": (episode + 1) * samples,
        "data/chunk_index": np.full(n, chunk),
        "data/file_index": np.full(n, file),
        "anatomy": [plan.names[block.anatomy]] * n,
        "anatomy_sha256": [plan.fingerprints[block.anatomy]] * n,
        "sequence": np.array(block.sequences),
        "split": plan.splits[block.anatomy, block.sequences.start : block.sequences.stop].tolist(),
        "device": [plan.device.name] * n,
        "friction": friction,
        "initial_inserted_length_mm": rollout.initial_inserted_length,
        "initial_rotation_rad": rollout.initial_rotation,
        "valid": rollout.valid.all(axis=1),
        "invalid_reason": _reasons(rollout),
        "meta/episodes/chunk_index": np.full(n, chunk),
        "meta/episodes/file_index": np.full(n, file),
    }


def _reasons(rollout: Rollout) -> list[str]:
    """Return why each world is invalid, "" for the valid ones."""
    return [
        ""
        if valid.all()
        else f"did not converge or left the finite numbers after {np.argmin(valid) * SAMPLE_PERIOD_S:g} s"
        for valid in rollout.valid
    ]


def _finish(plan: _Plan, blocks: Sequence[_Block], wall_seconds: float) -> None:
    """Write what describes the whole: statistics, task, info, and last the manifest."""
    import pandas as pd  # slow to import, and only needed here

    files = [schema.paths_of_file(plan.output, block.number) for block in blocks]
    episodes = [row for _, path in files for row in schema.read_table(path, plan.key).to_pylist()]
    with progress("Describing the dataset", total=len(files)) as advance:
        write_json(plan.output / schema.STATS_PATH, schema.statistics([path for path, _ in files], plan.key, advance))
    tasks = pd.DataFrame({"task_index": [0]}, index=pd.Index([schema.TASK], name="task"))
    with writing(plan.output / schema.TASKS_PATH) as partial:
        tasks.to_parquet(partial)
    samples = plan.config.samples
    write_json(plan.output / schema.INFO_PATH, schema.info(len(episodes), samples))
    told = ("episode_index", "anatomy", "sequence", "invalid_reason")
    invalid = [{name: row[name] for name in told} for row in episodes if not row["valid"]]
    record = manifest(
        config=plan.config,
        seed=plan.config.seed,
        inputs=dict(zip(plan.names, plan.fingerprints, strict=True)),
        complete=True,
        key=plan.key,
        settings=plan.settings,
        files=len(files),
        samples_per_episode=samples,
        device=asdict(plan.device),
        anatomies=[_anatomy_record(plan, i) for i in range(len(plan.names))],
        splits=dict(Counter(row["split"] for row in episodes)),
        stopped_short=sum(row["stopped_short"] for row in episodes),
        invalid={"episodes": len(invalid), "which": invalid},
        wall_seconds=wall_seconds,
    )
    write_json(plan.output / schema.MANIFEST_PATH, record)


def _anatomy_record(plan: _Plan, index: int) -> dict[str, Any]:
    """Return name, folder as seen from the dataset, and fingerprint of an anatomy."""
    folder = os.path.relpath(plan.folders[index].resolve(), plan.output.resolve())
    return {"name": plan.names[index], "folder": folder, "sha256": plan.fingerprints[index]}


def _version() -> str:
    return f"endopilot {__version__}, format {FORMAT_VERSION}"


def _plain(settings: Any) -> Any:
    """Return settings as JSON gives them back, so that they compare equal after a round trip through a file."""
    return json.loads(json_text(settings))


def _differences(before: Any, now: Any, name: str = "") -> Iterator[tuple[str, Any, Any]]:
    """Yield (field, value before, value now) for every leaf that differs between two nested mappings."""
    if isinstance(before, dict) and isinstance(now, dict):
        for key in sorted(before.keys() | now.keys()):
            yield from _differences(before.get(key, "absent"), now.get(key, "absent"), f"{name}.{key}".lstrip("."))
    elif before != now:
        yield name, before, now
