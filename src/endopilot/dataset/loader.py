"""A dataset on disk as arrays in memory."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int, Shaped

from endopilot.anatomy.io import read_anatomy
from endopilot.dataset import schema
from endopilot.dataset.layout import identify, version
from endopilot.dataset.navigations import stacks_with_tips
from endopilot.devices.catheter import Catheter
from endopilot.devices.device import Wire
from endopilot.devices.robot import RobotConfig
from endopilot.devices.stack import Stack, column_prefixes
from endopilot.errors import InputError
from endopilot.extras import extra_named
from endopilot.files import read_json, reading
from endopilot.runs import RECORD_FILE
from endopilot.settings import from_record
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.motion import Motion
from endopilot.simulation.signals import SIGNALS, Outputs, described
from endopilot.simulation.simulate import run_set_up
from endopilot.simulation.trajectory import SimulationSetUp, Trajectory
from endopilot.simulation.world import World
from endopilot.types import Anatomy

_MEND = "make the dataset again"


@described
@dataclass(frozen=True, eq=False, kw_only=True)
class Dataset(Outputs):
    """Episodes of equal length. Sample t is the state at the end of period t; `control[:, t]` is the mean over it.

    Device 0 is the wire; the catheters around it follow from the inside out. `command`, simulated again, gives the same
    navigation to the bit, which `control` does not: a drive that pushes at one speed until it slips strains the wire
    otherwise than one that is slower from the start. Where no robot made the motions, `decided`, `encoders` and `load`
    are None; else `command` is what its drives made of what was decided, as the mean over a sample.

    Attributes:
        folder: where it was read from.
        manifest: how it was made (`meta/manifest.json`).
        sample_period_s: time between samples, s.
        anatomy: name of each episode's anatomy.
        sequence: index of each episode among those of its anatomy.
        split: "train", "seen_test", "calibrate" or "test".
        tip_bend: angle by which the unloaded tip is bent, rad.
        tip_stiffness_factor: factor on the stiffness of the device's distal 10 mm.
        branch: index of the branch that the tip lies in.
        lumen_radius: lumen radius at the tip's projection, mm.
    """

    folder: Path
    manifest: dict[str, Any]
    sample_period_s: float
    anatomy: Shaped[np.ndarray, "episodes"]
    sequence: Int[np.ndarray, "episodes"]
    split: Shaped[np.ndarray, "episodes"]
    friction: Float[np.ndarray, "episodes devices"]
    tip_bend: Float[np.ndarray, "episodes"]
    tip_stiffness_factor: Float[np.ndarray, "episodes"]
    initial: Float[np.ndarray, "episodes devices 2"]
    command: Float[np.ndarray, "episodes samples devices 2"]
    control: Float[np.ndarray, "episodes samples devices 2"]
    tip_abscissa: Float[np.ndarray, "episodes samples devices"]
    tip_offset: Float[np.ndarray, "episodes samples devices"]
    branch: Int[np.ndarray, "episodes samples devices"]
    lumen_radius: Float[np.ndarray, "episodes samples devices"]
    decided: Float[np.ndarray, "episodes samples devices 2"] | None = None
    encoders: Float[np.ndarray, "episodes samples devices 2"] | None = None
    load: Float[np.ndarray, "episodes samples devices 2"] | None = None

    def __len__(self) -> int:
        """Return the number of episodes."""
        return len(self.anatomy)

    @property
    def stack(self) -> Stack:
        """The wire as it was given, and the catheters around it."""
        catheters = tuple(from_record(Catheter, record) for record in self.manifest["catheters"])
        return Stack(from_record(Wire, self.manifest["device"]), catheters)

    def __getitem__(self, episodes: int | slice | Shaped[np.ndarray, "chosen"]) -> Dataset:
        """Return an episode by its number, or several by a mask or numbers; InputError for one that there is not."""
        if isinstance(episodes, int):
            if not 0 <= episodes < len(self):
                raise InputError(f"world: {episodes}; {self.folder} has episodes 0 to {len(self) - 1}")
            episodes = slice(episodes, episodes + 1)
        arrays = {each.name: getattr(self, each.name) for each in fields(self)}
        chosen = {name: values[episodes] for name, values in arrays.items() if isinstance(values, np.ndarray)}
        return replace(self, **chosen)

    def set_up(self, anatomy: Anatomy | None = None) -> SimulationSetUp:
        """Return what episodes of one anatomy (read if not given; InputError if missing or another one) were simulated
        with; their `command` then gives them again to the bit."""
        anatomy = anatomy or read_anatomy(self.anatomy_folder(str(self.anatomy[0])))
        world, config = self.world, self.manifest["config"]
        return SimulationSetUp(
            anatomies=[world.anatomy(anatomy)] * len(self),
            stacks=stacks_with_tips(self.stack, world, self.tip_bend, self.tip_stiffness_factor),
            initial=self.initial,
            friction=self.friction,
            actuation=config["control"],
            motion=self.motion(anatomy.name),
            config=world.core(SimulatorConfig(**config["simulator"])),
        )

    def trajectory(self, episode: int, *, record_shape: bool = False) -> Trajectory:
        """Return an episode as it was recorded, to the bit: its commands simulated again, if asked for with the
        positions of all nodes. Raises InputError for no such episode, or an anatomy that is missing or another."""
        return self[episode].driven(record_shape=record_shape)

    def driven(
        self,
        velocity: Float[np.ndarray, "episodes samples devices 2"] | None = None,
        *,
        anatomy: Anatomy | None = None,
        friction: Float[np.ndarray, "episodes devices"] | None = None,
        record_shape: bool = False,
    ) -> Trajectory:
        """Simulate episodes of one anatomy again, a world each: by other velocities (mm/s, rad/s) than the recorded
        commands, or with other friction, if given; the anatomy is read from its folder if not given."""
        set_up, command = self.set_up(anatomy), self.command if velocity is None else velocity
        set_up = set_up if velocity is None else replace(set_up, actuation="velocity")
        set_up = set_up if friction is None else replace(set_up, friction=friction)
        return run_set_up(set_up, command, period_s=self.sample_period_s, record_shape=record_shape)

    def of_split(self, split: str) -> Dataset:
        """Return the episodes of one split that are valid to the end; InputError if there are none."""
        chosen = (self.split == split) & self.valid.all(axis=1)
        if not chosen.any():
            held = ", ".join(sorted(set(self.split.tolist())))
            raise InputError(
                f"{self.folder}: no valid episode in split '{split}' (it has {held}); "
                "make the dataset with more anatomies or sequences"
            )
        return self[chosen]

    @property
    def robot(self) -> RobotConfig | None:
        """What made the motions; None where they were made as drawn."""
        record = self.manifest.get("robot")
        return None if record is None else from_record(RobotConfig, record)

    @property
    def world(self) -> World:
        """What reality was, with what the seed drew; the wire, the anatomies and tips' radii aside are as given. Raises
        InputError if the episodes are of several worlds."""
        record = self.manifest.get("world", {})
        if record is None:
            raise InputError(f"{self.folder}: holds episodes of several worlds; give the dataset of one world")
        return from_record(World, record, onto=World()).drawn(None, self.manifest["seed"])

    @property
    def patients(self) -> dict[str, str]:
        """SHA-256 of what a simulation depends on in each anatomy, by the anatomy's name."""
        return {record["name"]: record["sha256"] for record in self.manifest["anatomies"]}

    def motion(self, anatomy: str) -> Motion | None:
        """Return how the vessel of an anatomy, given by name, moves in the episodes; None if it lies still."""
        found = self._record(anatomy).get("motion")
        return None if found is None else Motion(**found)

    def _record(self, anatomy: str) -> dict[str, Any]:
        return next(record for record in self.manifest["anatomies"] if record["name"] == anatomy)

    def anatomy_folder(self, name: str) -> Path:
        """Return an anatomy's folder; InputError if it is missing, or another than the dataset was made in."""
        record = self._record(name)
        folder = (self.folder / record["folder"]).resolve()
        if identify(folder) != (name, record["sha256"]):
            raise InputError(f"{folder}: is not the anatomy that {self.folder} was made in; make the dataset again")
        return folder


def read_manifest(folder: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Read how a finished dataset was made, `meta/manifest.json`, and what it holds, `meta/info.json`; InputError if
    there is none, or one of another version."""
    if not (folder / schema.MANIFEST_PATH).exists():
        if (folder / RECORD_FILE).exists():
            raise InputError(f"{folder}: the dataset is unfinished; run the same `endopilot dataset` command again")
        raise InputError(
            f"{folder}: no dataset here ({schema.MANIFEST_PATH} is missing); make one with `endopilot dataset`"
        )
    manifest = read_json(folder / schema.MANIFEST_PATH, keys=("key", "settings"), mend=_MEND)
    with reading(folder / schema.MANIFEST_PATH, _MEND):
        made = manifest["settings"].get("version")
        parts = (record[part] for record in manifest["anatomies"] for part in ("name", "sha256", "folder"))
        if not all(isinstance(text, str) for text in (manifest["key"], *parts)):
            raise ValueError("key or anatomies: no text")
    if made != version():
        raise InputError(f"{folder}: made by {made}, which {version()} cannot read; make the dataset again")
    if not (folder / schema.INFO_PATH).exists():
        raise InputError(
            f"{folder / schema.INFO_PATH}: missing from the dataset; run the same `endopilot dataset` command again"
        )
    info = read_json(folder / schema.INFO_PATH, keys=("features", "fps", "total_episodes", "total_frames"), mend=_MEND)
    if info.get("codebase_version") != schema.LEROBOT_VERSION:
        found = info.get("codebase_version")
        raise InputError(
            f"{folder / schema.INFO_PATH}: codebase_version is {found}, not {schema.LEROBOT_VERSION}; make it again"
        )
    return manifest, info


def read_dataset(folder: str | Path) -> Dataset:
    """Read a finished dataset whole. Raises InputError for none, or one that is damaged or of another version."""
    with extra_named("reading a dataset"):
        import endopilot.dataset.parquet  # noqa: F401

    folder = Path(folder)
    manifest, info = read_manifest(folder)
    with reading(folder, _MEND):
        return _of_files(folder, manifest, info)


def _of_files(folder: Path, manifest: dict[str, Any], info: dict[str, Any]) -> Dataset:
    from endopilot.dataset.parquet import column_values, read_tables

    samples, total = manifest["samples_per_episode"], info["total_episodes"]
    columns = schema.signals_in(info["features"])
    devices, by_robot = int(info["features"]["branch"]["shape"][0]), "encoders" in columns
    paths = [schema.paths_of_file(folder, number) for number in range(manifest["files"])]
    data, table = (read_tables([pair[kind] for pair in paths], manifest["key"]) for kind in (0, 1))
    if (data.num_rows, table.num_rows) != (total * samples, total):
        raise InputError(
            f"{folder}: {table.num_rows} episodes and {data.num_rows} samples where {schema.INFO_PATH} counts {total} "
            f"and {total * samples}; run `endopilot dataset` again"
        )
    episode = {name: column_values(table, name) for name in table.column_names}
    signal: dict[str, np.ndarray] = {}
    for name in columns:  # each is let go as it is taken, so that a large dataset is never held twice
        values = np.array(column_values(data, name))
        signal[name], data = values.reshape(total, samples, *values.shape[1:]), data.drop_columns(name)
    shape = (total, samples, devices)
    vectors = {name: signal[name].reshape(*shape, -1) for name in ("action", "velocity") if name in signal}
    recorded = {name: _of_signal(name, signal[column], devices) for column, (name, *_) in schema.OWN_COLUMNS.items()}
    recorded |= {name: signal["observation.state"].reshape(*shape, -1)[..., k] for k, name in enumerate(schema.STATE)}
    if "velocity" in vectors:
        control = vectors["velocity"]
    else:
        slip = np.stack([recorded["slip"], recorded["rotation_slip"]], axis=-1)
        control = (vectors["action"] - slip * info["fps"]).astype(np.float32)
    recorded |= {name: signal[name].reshape(*shape, 2) for name in schema.OF_ROBOT if by_robot}
    prefixes = column_prefixes(devices)
    starts = [f"{prefix}initial_{name}" for prefix in prefixes for name in ("inserted_length_mm", "rotation_rad")]
    return Dataset(
        folder=folder,
        manifest=manifest,
        sample_period_s=1 / info["fps"],
        anatomy=episode["anatomy"].astype(str),
        sequence=episode["sequence"],
        split=episode["split"].astype(str),
        friction=np.stack([episode[f"{prefix}friction"] for prefix in prefixes], axis=-1),
        tip_bend=episode["tip_bend_rad"],
        tip_stiffness_factor=episode["tip_stiffness_factor"],
        initial=np.stack([episode[name] for name in starts], axis=-1).reshape(total, devices, 2),
        command=vectors["action"],
        control=control,
        branch=recorded.pop("tip_branch"),
        lumen_radius=recorded.pop("tip_radius"),
        **recorded,
    )


def _of_signal(name: str, values: np.ndarray, devices: int) -> np.ndarray:
    """Return a signal (episodes, samples, ...) with axes of devices and numbers in place of its axis of components."""
    if not SIGNALS[name].of_devices:
        return values
    return values.reshape(*values.shape[:2], devices, *([-1] if len(SIGNALS[name].columns) > 1 else []))


_WIRE = (
    *("diameter_mm", "abscissa_mm", "bend_stiffness_n_mm2", "twist_stiffness_n_mm2"),
    *("tip_bend_rad", "tip_bend_length_mm"),
)
"""What makes a wire another one; friction is the navigation's own, and limits are the drive's."""


def check_same_wire(dataset: Dataset, other: Mapping[str, Any], of: Path, mend: str) -> None:
    """Raise InputError, with the mend, unless a dataset was made with the wire of another dataset or run (`of`)."""
    ours = dataset.manifest["device"]
    for name in _WIRE:
        if not np.array_equal(ours[name], other[name]):
            raise InputError(
                f"{dataset.folder}: its wire is {ours['name']}, and that of {of} is {other['name']}, with another "
                f"{name}; {mend}"
            )


def read_joined(folders: Sequence[Path]) -> Dataset:
    """Read datasets as one; a patient that the first holds keeps its split, so nothing kept for a test is trained on.
    Raises InputError where one cannot be read, or has other devices, episodes of another length, another patient of the
    same name, or the same one who moves otherwise."""
    if not folders:
        raise InputError("dataset: none given; name at least one folder made by `endopilot dataset`")
    first, *others = (read_dataset(folder) for folder in folders)
    for other in others:
        first = _joined(first, other)
    return first


def _joined(first: Dataset, other: Dataset) -> Dataset:
    _check_alike(first, other)
    home = dict(zip(first.anatomy.tolist(), first.split.tolist(), strict=True))
    held = {name: split if split in ("calibrate", "test") else None for name, split in home.items()}
    split = [held.get(name) or own for name, own in zip(other.anatomy.tolist(), other.split.tolist(), strict=True)]
    other = replace(other, split=np.array(split))
    records = {record["name"]: record for record in first.manifest["anatomies"]}
    for record in other.manifest["anatomies"]:
        folder = (other.folder / record["folder"]).resolve()
        records.setdefault(record["name"], record | {"folder": os.path.relpath(folder, first.folder.resolve())})
    keys = [first.manifest["key"], other.manifest["key"]]
    manifest = first.manifest | {
        "key": hashlib.sha256("".join(keys).encode()).hexdigest(),
        "anatomies": list(records.values()),
        "world": ours if (ours := first.manifest.get("world", {})) == other.manifest.get("world", {}) else None,
    }
    names = [field.name for field in fields(Dataset) if field.name not in ("folder", "manifest", "sample_period_s")]
    pairs = {name: (getattr(first, name), getattr(other, name)) for name in names}
    # where one of them has no robot, neither has what it measured
    arrays = {
        name: np.concatenate(pair) if all(isinstance(part, np.ndarray) for part in pair) else None
        for name, pair in pairs.items()
    }
    return replace(first, manifest=manifest, **arrays)


def _check_alike(first: Dataset, other: Dataset) -> None:
    check_same_wire(other, first.manifest["device"], first.folder, "join datasets of one wire")
    if first.stack.catheters != other.stack.catheters:
        around = [", ".join(each.name for each in data.stack.catheters) or "no catheter" for data in (other, first)]
        raise InputError(
            f"{other.folder}: its wire lies in {around[0]}, and that of {first.folder} in {around[1]}; join datasets "
            "of the same devices"
        )
    length, other_length = (dataset.valid.shape[1] * dataset.sample_period_s for dataset in (first, other))
    if length != other_length:
        raise InputError(
            f"{other.folder}: episodes of {other_length:g} s, and those of {first.folder} take {length:g} s; "
            f"make it with --seconds {length:g}"
        )
    for name in first.patients.keys() & other.patients.keys():
        if first.patients[name] != other.patients[name]:
            raise InputError(f"{other.folder}: its patient {name} is another than that of {first.folder}; rename one")
        if first.motion(name) != other.motion(name):
            raise InputError(
                f"{other.folder}: its patient {name} moves otherwise than in {first.folder}; join datasets of other "
                "patients, or of one motion"
            )
