"""The blocks of navigations that make up a dataset, each simulated and stored by itself: `make_layout`."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Shaped

from endopilot import __version__
from endopilot.anatomy.io import read_anatomy
from endopilot.dataset import schema
from endopilot.dataset.config import DatasetConfig
from endopilot.dataset.navigations import patient_motion
from endopilot.devices.catheter import check_nested
from endopilot.devices.robot import RobotConfig
from endopilot.devices.stack import Stack
from endopilot.errors import InputError
from endopilot.files import json_text, read_json
from endopilot.simulation.motion import Motion
from endopilot.simulation.world import World

SPLITS = ("train", "seen_test", "calibrate", "test")
DEFAULT_ANATOMY_SHARES = (0.6, 0.2, 0.2)  # shares of the anatomies that train, calibrate and test


def assign_splits(
    names: Sequence[str],
    n_sequences: int,
    *,
    anatomy_shares: tuple[float, float, float] | None = None,
    seen_test_share: float = 0.2,
) -> Shaped[np.ndarray, "anatomies sequences"]:
    """Return the split of every sequence of every anatomy, one of `SPLITS`: fixed by hash, not by chance or order.

    Whole patients go to train, calibrate or test, dealt out by the SHA-256 of their names as close to the shares as few
    patients allow (a single one is not divided); of those in train `seen_test_share` of the navigations, by that of
    "name/index", are held out: new controls on known vessels, the paper's likely reading of its 80/20 split. Raises
    InputError for too few of either.
    """
    if anatomy_shares is None:
        anatomy_shares = (1.0, 0.0, 0.0) if len(names) == 1 else DEFAULT_ANATOMY_SHARES
    counts = _counts(len(names), anatomy_shares)
    order = sorted(range(len(names)), key=lambda i: _digest(names[i]))
    by_anatomy = np.empty(len(names), dtype="<U9")
    by_anatomy[order] = np.repeat(np.array(["train", "calibrate", "test"]), counts)

    splits = np.repeat(by_anatomy[:, None], n_sequences, axis=1)
    held_out = 0
    if counts[0] and seen_test_share:
        if n_sequences < 2:
            raise InputError(
                f"sequences: {n_sequences} cannot be split into train and seen_test; "
                "give at least 2 or set seen_test_share to 0"
            )
        held_out = min(max(round(n_sequences * seen_test_share), 1), n_sequences - 1)
    for row, name in enumerate(names):
        if by_anatomy[row] == "train":
            ranked = sorted(range(n_sequences), key=lambda i: _digest(f"{name}/{i}"))
            splits[row, ranked[:held_out]] = "seen_test"
    return splits


def _counts(n: int, shares: tuple[float, float, float]) -> list[int]:
    """Turn shares into counts: one for each positive share, the rest by the largest shortfall (first split first)."""
    wanted = [share > 0 for share in shares]
    if n < sum(wanted):
        raise InputError(
            f"anatomy_shares: {n} anatomies cannot fill {sum(wanted)} splits (train, calibrate, test = {shares}); "
            f"give at least {sum(wanted)} anatomies or set a share to 0"
        )
    counts = [int(share) for share in wanted]
    while sum(counts) < n:
        shortfall = [n * share - count for share, count in zip(shares, counts, strict=True)]
        counts[shortfall.index(max(shortfall))] += 1
    return counts


def _digest(text: str) -> bytes:
    return hashlib.sha256(text.encode()).digest()


FORMAT_VERSION = 7  # counts changes of the columns or of their meaning


class Patient(NamedTuple):
    """An anatomy of a data set: its folder, name, SHA-256 of what a simulation depends on, and how it moves."""

    folder: Path
    name: str
    identity: str
    motion: Motion | None


@dataclass(frozen=True, eq=False)
class Block:
    """Navigations of one anatomy that share a file: the unit of work, on this machine or on a cluster, with the
    navigations' indices, the first one's in the dataset, and their splits."""

    number: int
    patient: Patient
    sequences: range
    first_episode: int
    splits: Shaped[np.ndarray, "n"]


@dataclass(frozen=True, eq=False)
class Layout:
    """Which navigations of which anatomies a dataset holds. A resumed run must share its `settings`, from which the
    `key` of its files follows; `task` is LeRobot's, the robot None where motions are made as drawn, and devices and
    anatomies are as given, whatever the world is."""

    output: Path
    config: DatasetConfig
    stack: Stack
    task: str
    robot: RobotConfig | None
    world: World
    patients: tuple[Patient, ...]
    splits: Shaped[np.ndarray, "anatomies sequences"]
    settings: dict[str, Any]
    key: str

    def blocks(self) -> list[Block]:
        """Return the blocks in the order of their files."""
        n, size, blocks = self.config.sequences, self.config.sequences_per_file, []
        for row, patient in enumerate(self.patients):
            for first in range(0, n, size):
                chosen = range(first, min(first + size, n))
                splits = self.splits[row, chosen.start : chosen.stop]
                blocks.append(Block(len(blocks), patient, chosen, row * n + first, splits))
        return blocks


def make_layout(
    folders: Sequence[Path],
    output: Path,
    stack: Stack,
    config: DatasetConfig,
    *,
    task: str = schema.TASK,
    robot: RobotConfig | None = None,
    world: World | None = None,
    origin: Mapping[str, Any] | None = None,
) -> Layout:
    """Read the anatomies' records, and lay out the dataset in blocks; `origin` is what they follow from if not drawn.
    Raises InputError for a folder without anatomy, two of one name, too few for the split, catheters that do not fit or
    are to be driven by force, or a world that a dataset cannot hold."""
    world = world or World()
    world.check_engine("datasets")
    for name in ("share", "backs_out_mm"):
        if (value := getattr(world, name)) != getattr(World(), name):
            raise InputError(f"world: {name} = {value}; it is not the same throughout a dataset: leave it out")
    check_nested(stack.wire, stack.catheters)
    if stack.catheters and config.control == "force":
        raise InputError("control: 'force' with catheters; give 'velocity'")
    if robot is not None and config.control == "force":
        raise InputError("control: 'force' with a robot, which takes velocities; give 'velocity'")
    if not folders:
        raise InputError("anatomies: none given; name at least one folder made by `endopilot anatomy`")
    names, identities = zip(*(identify(Path(folder)) for folder in folders), strict=True)
    check_names(names)
    splits = assign_splits(
        names, config.sequences, anatomy_shares=config.anatomy_shares, seen_test_share=config.seen_test_share
    )
    described = asdict(config)
    del described["simulator"]["threads"]  # no bit depends on it
    settings = {
        "config": described,
        "device": asdict(stack.wire),
        "anatomies": dict(zip(names, identities, strict=True)),
        "version": version(),
        **({"catheters": [asdict(catheter) for catheter in stack.catheters]} if stack.catheters else {}),
        **({} if robot is None else {"robot": asdict(robot)}),
        **({} if world == World() else {"world": world.differences()}),
        **(origin or {}),
    }
    settings, key = settled(settings)
    motions = (world.motion or patient_motion(config, name) for name in names)
    there = (Path(folder).resolve() for folder in folders)  # a cluster's workers may stand elsewhere
    patients = tuple(map(Patient, there, names, identities, motions))
    return Layout(Path(output).resolve(), config, stack, task, robot, world, patients, splits, settings, key)


def check_names(names: Sequence[str]) -> None:
    """Raise InputError where two patients have one name."""
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"anatomies: {names.count(name)} are named '{name}'; give each patient a name of its own")


def settled(settings: Mapping[str, Any]) -> tuple[dict[str, Any], str]:
    """Return settings as JSON gives them back, so that they compare equal, and the key that marks all files of such a
    data set."""
    again = json.loads(json_text(settings))
    return again, hashlib.sha256(json_text(again).encode()).hexdigest()


def version() -> str:
    """Return the version that all files of a dataset must have been written by."""
    return f"endopilot {__version__}, format {FORMAT_VERSION}"


def identify(folder: Path) -> tuple[str, str]:
    """Return an anatomy's name and identity, from its record or, where that lacks it, its content; InputError."""
    path = folder / "anatomy.json"
    record = read_json(path) if path.exists() else {}
    if isinstance(record, dict) and {"name", "identity"} <= record.keys():
        return str(record["name"]), str(record["identity"])
    anatomy = read_anatomy(folder)
    return anatomy.name, anatomy.identity
