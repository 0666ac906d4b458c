"""What a dataset is to be: its settings, and the blocks of navigations that are simulated and stored one by one."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from jaxtyping import Shaped
from pydantic import model_validator

from endopilot import __version__
from endopilot.anatomy.io import read_anatomy
from endopilot.dataset.splits import assign_splits
from endopilot.errors import InputError
from endopilot.files import json_text, read_json
from endopilot.settings import Ascending, Count, NonNegative, Positive, Seed, Share, ShareBelowOne, Within, settings
from endopilot.simulation.config import Actuation, SimulatorConfig
from endopilot.simulation.controls import ControlConfig
from endopilot.simulation.device import Device
from endopilot.types import SAMPLE_PERIOD_S

FORMAT_VERSION = 4
"""Counts changes of the columns or of their meaning."""


def dataset_simulator() -> SimulatorConfig:
    """Return the settings that datasets are simulated with: half the elements of the reference and a coarser Newton.

    What they cost in accuracy stands in docs/dataset.md.
    """
    return SimulatorConfig(elements=50, tolerance_mm=1e-2, largest_jump=0.3)


_Stiffness = Annotated[float, Within(0.05)]


@settings
class DatasetConfig:
    """How many navigations, how long, how they are driven and how they are split."""

    sequences: Count = 1000
    """Random navigations of each anatomy."""
    seconds: Positive = 60.0
    """Length of a navigation, s; one sample every 0.5 s."""
    seed: Seed = 0
    """Seed of the random controls and parameters."""
    control: Actuation = "velocity"
    """What is drawn: the drive's velocity, or its force and torque."""
    navigation: ControlConfig = field(default_factory=ControlConfig)
    """Distribution of the random controls."""
    simulator: SimulatorConfig = field(default_factory=dataset_simulator)
    """Settings of the rod simulation."""
    friction: Annotated[tuple[NonNegative, NonNegative], Ascending] | None = None
    """Range that each navigation's friction coefficient is drawn from uniformly; the device's own if not given."""
    tip_bend_factor: Annotated[tuple[NonNegative, NonNegative], Ascending] | None = None
    """Range of a factor on the angle of the device's bent tip, drawn uniformly for each eight navigations."""
    tip_stiffness_factor: Annotated[tuple[_Stiffness, _Stiffness], Ascending] | None = None
    """Range of a factor on the stiffness of the distal 10 mm, drawn likewise."""
    anatomy_shares: tuple[Share, Share, Share] | None = None
    """Shares of the anatomies that train, calibrate and test; 0.6 0.2 0.2 if not given, and a single anatomy is then
    split by sequence alone."""
    seen_test_share: ShareBelowOne = 0.2
    """Share of the navigations of a train anatomy that are held out as the split seen_test."""
    sequences_per_file: Count = 500
    """Navigations stored in one file; an interrupted run loses at most one file's work a processor core."""

    @model_validator(mode="after")
    def _consistent(self) -> DatasetConfig:
        samples = self.seconds / SAMPLE_PERIOD_S
        if samples != int(samples):
            raise ValueError(f"seconds: {self.seconds} is no multiple of {SAMPLE_PERIOD_S} s; give e.g. 60")
        shares = self.anatomy_shares
        if shares is not None and not (shares[0] > 0 and abs(sum(shares) - 1) < 1e-3):
            raise ValueError(f"anatomy_shares: {shares}; give three shares that add up to 1, the first positive")
        return self

    @property
    def samples(self) -> int:
        """Number of samples of a navigation."""
        return round(self.seconds / SAMPLE_PERIOD_S)


@dataclass(frozen=True, eq=False)
class Block:
    """Navigations of one anatomy that share a file: the unit of work, on this machine or on a cluster.

    Attributes:
        number: of the file.
        folder: of the anatomy.
        anatomy: its name.
        fingerprint: SHA-256 of what the simulation depends on in it.
        sequences: indices of the navigations among those of the anatomy.
        first_episode: index of the first one in the dataset.
        splits: split of each.
    """

    number: int
    folder: Path
    anatomy: str
    fingerprint: str
    sequences: range
    first_episode: int
    splits: Shaped[np.ndarray, "n"]


@dataclass(frozen=True, eq=False)
class Plan:
    """What all blocks share.

    Attributes:
        output: folder of the dataset.
        config: number, length, distribution and split of the navigations.
        device: the wire.
        key: marks the files of this dataset; it follows from all settings.
    """

    output: Path
    config: DatasetConfig
    device: Device
    key: str


@dataclass(frozen=True, eq=False)
class Study:
    """A plan with the anatomies that it is carried out on.

    Attributes:
        plan: what all blocks share.
        folders: of the anatomies.
        names: theirs.
        fingerprints: theirs.
        splits: of every navigation.
        settings: what a resumed run must share with the run it continues, as plain JSON values.
    """

    plan: Plan
    folders: tuple[Path, ...]
    names: tuple[str, ...]
    fingerprints: tuple[str, ...]
    splits: Shaped[np.ndarray, "anatomies sequences"]
    settings: dict[str, Any]

    def blocks(self) -> list[Block]:
        """Return the blocks in the order of their files."""
        n, size, blocks = self.plan.config.sequences, self.plan.config.sequences_per_file, []
        for row, (folder, name, fingerprint) in enumerate(
            zip(self.folders, self.names, self.fingerprints, strict=True)
        ):
            for first in range(0, n, size):
                chosen = range(first, min(first + size, n))
                splits = self.splits[row, chosen.start : chosen.stop]
                blocks.append(Block(len(blocks), folder, name, fingerprint, chosen, row * n + first, splits))
        return blocks


def plan_study(folders: Sequence[Path], output: Path, device: Device, config: DatasetConfig) -> Study:
    """Look at the anatomies, and say what the dataset will be.

    Raises:
        InputError: no anatomy, or a folder that is none; two of one name; too few for the split.
    """
    if not folders:
        raise InputError("anatomies: none given; name at least one folder made by `endopilot anatomy`")
    names, fingerprints = zip(*(identify(Path(folder)) for folder in folders), strict=True)
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"anatomies: {names.count(name)} are named '{name}'; give each patient a name of its own")
    splits = assign_splits(
        names, config.sequences, anatomy_shares=config.anatomy_shares, seen_test_share=config.seen_test_share
    )
    described = asdict(config)
    del described["simulator"]["threads"]  # no bit depends on it
    settings = {
        "config": described,
        "device": asdict(device),
        "anatomies": dict(zip(names, fingerprints, strict=True)),
        "version": version(),
    }
    settings = json.loads(json_text(settings))  # as a file gives them back, so that they compare equal
    key = hashlib.sha256(json_text(settings).encode()).hexdigest()
    plan = Plan(Path(output), config, device, key)
    return Study(plan, tuple(map(Path, folders)), names, fingerprints, splits, settings)


def version() -> str:
    """Return what the files of a dataset must have been written by to belong together."""
    return f"endopilot {__version__}, format {FORMAT_VERSION}"


def identify(folder: Path) -> tuple[str, str]:
    """Return an anatomy's name and its identity, from its record; one that does not state it is read whole.

    Raises:
        InputError: the folder holds no anatomy, or a damaged one.
    """
    path = folder / "anatomy.json"
    record = read_json(path) if path.exists() else {}
    if isinstance(record, dict) and {"name", "identity"} <= record.keys():
        return str(record["name"]), str(record["identity"])
    anatomy = read_anatomy(folder)
    return anatomy.name, anatomy.identity
