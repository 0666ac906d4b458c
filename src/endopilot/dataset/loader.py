"""A dataset on disk as arrays in memory."""

from __future__ import annotations

import re
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from endopilot.dataset.layout import identify, version
from endopilot.dataset.schema import (
    INFO_PATH,
    LEROBOT_VERSION,
    MANIFEST_PATH,
    OF_CATHETER,
    actuation_of,
    catheters_of,
    paths_of_file,
    signals,
)
from endopilot.devices.catheter import Catheter
from endopilot.errors import InputError
from endopilot.extras import extra_named
from endopilot.files import read_json, reading
from endopilot.runs import RECORD_FILE
from endopilot.settings import from_record
from endopilot.simulation.motion import Motion

_MEND = "make the dataset again"


@dataclass(frozen=True, eq=False)
class Dataset:
    """Episodes of equal length. Sample t is the state at the end of period t; `control[:, t]` is the mean over it.

    Attributes:
        folder: where it was read from.
        manifest: how it was made (`meta/manifest.json`).
        sample_period_s: time between samples, s.
        anatomy: name of each episode's anatomy.
        sequence: index of each episode among those of its anatomy.
        split: "train", "seen_test", "calibrate" or "test".
        device: name of the wire.
        friction: friction coefficient between wire and wall.
        tip_bend: angle by which the unloaded tip is bent, rad.
        tip_stiffness_factor: factor on the stiffness of the device's distal 10 mm.
        initial_inserted_length: Δ before the first period, mm.
        initial_rotation: φ before the first period, rad.
        control: π = (dΔ/dt mm/s, dφ/dt rad/s): the applied velocity, or that which resulted from force and torque.
        inserted_length: Δ, mm.
        rotation: φ, rad, unwrapped.
        tip_abscissa: Δtip, mm.
        tip_offset: γtip, mm.
        tip_position: LPS mm.
        tip_direction: unit vector along the wire at its tip.
        branch: index of the branch that the tip lies in.
        lumen_radius: lumen radius at the tip's projection, mm.
        contact_force_max: largest wall force on one node, N.
        contact_force_sum: sum of the wall forces' magnitudes, N.
        base_force: axial force of the drive, N, positive when it pushes.
        base_torque: torque of the drive, N·mm.
        drive_force: axial force of the drive with what the introducer's valve takes, N.
        drive_torque: torque of the drive, likewise, N·mm.
        slip: advance that was commanded and not made over the period, mm; nearly always 0.
        rotation_slip: rotation likewise, rad.
        valid: false from the sample in which the simulation of that episode failed.
        catheter_initial: (Δ mm, φ rad) of each catheter before the first period; the fields of catheters that follow
            mean what those of the wire do. A wire alone has none: their axis has the length 0.
    """

    folder: Path
    manifest: dict[str, Any]
    sample_period_s: float
    anatomy: Shaped[np.ndarray, "episodes"]
    sequence: Int[np.ndarray, "episodes"]
    split: Shaped[np.ndarray, "episodes"]
    device: Shaped[np.ndarray, "episodes"]
    friction: Float[np.ndarray, "episodes"]
    tip_bend: Float[np.ndarray, "episodes"]
    tip_stiffness_factor: Float[np.ndarray, "episodes"]
    initial_inserted_length: Float[np.ndarray, "episodes"]
    initial_rotation: Float[np.ndarray, "episodes"]
    control: Float[np.ndarray, "episodes samples 2"]
    inserted_length: Float[np.ndarray, "episodes samples"]
    rotation: Float[np.ndarray, "episodes samples"]
    tip_abscissa: Float[np.ndarray, "episodes samples"]
    tip_offset: Float[np.ndarray, "episodes samples"]
    tip_position: Float[np.ndarray, "episodes samples 3"]
    tip_direction: Float[np.ndarray, "episodes samples 3"]
    branch: Int[np.ndarray, "episodes samples"]
    lumen_radius: Float[np.ndarray, "episodes samples"]
    contact_force_max: Float[np.ndarray, "episodes samples"]
    contact_force_sum: Float[np.ndarray, "episodes samples"]
    base_force: Float[np.ndarray, "episodes samples"]
    base_torque: Float[np.ndarray, "episodes samples"]
    drive_force: Float[np.ndarray, "episodes samples"]
    drive_torque: Float[np.ndarray, "episodes samples"]
    slip: Float[np.ndarray, "episodes samples"]
    rotation_slip: Float[np.ndarray, "episodes samples"]
    valid: Bool[np.ndarray, "episodes samples"]
    catheter_initial: Float[np.ndarray, "episodes catheters 2"]
    catheter_control: Float[np.ndarray, "episodes samples catheters 2"]
    catheter_inserted_length: Float[np.ndarray, "episodes samples catheters"]
    catheter_rotation: Float[np.ndarray, "episodes samples catheters"]
    catheter_tip_abscissa: Float[np.ndarray, "episodes samples catheters"]
    catheter_tip_offset: Float[np.ndarray, "episodes samples catheters"]
    catheter_tip_position: Float[np.ndarray, "episodes samples catheters 3"]
    catheter_branch: Int[np.ndarray, "episodes samples catheters"]
    catheter_base_force: Float[np.ndarray, "episodes samples catheters"]
    catheter_base_torque: Float[np.ndarray, "episodes samples catheters"]
    catheter_drive_force: Float[np.ndarray, "episodes samples catheters"]
    catheter_drive_torque: Float[np.ndarray, "episodes samples catheters"]
    catheter_slip: Float[np.ndarray, "episodes samples catheters"]
    catheter_rotation_slip: Float[np.ndarray, "episodes samples catheters"]

    def __len__(self) -> int:
        """Return the number of episodes."""
        return len(self.anatomy)

    @property
    def catheters(self) -> tuple[Catheter, ...]:
        """Catheters around the wire, from the inside out; none around a wire alone."""
        return tuple(from_record(Catheter, record) for record in self.manifest.get("catheters", ()))

    def check_wire_alone(self, what: str) -> None:
        """Check that the dataset's wire has no catheter around it, for what takes a wire alone.

        Args:
            what: what takes a wire alone, as the line ends.

        Raises:
            InputError: it has one.
        """
        if self.catheters:
            names = ", ".join(catheter.name for catheter in self.catheters)
            raise InputError(
                f"{self.folder}: its wires lie in {names}, and {what} takes a wire alone; "
                "make a dataset without --catheter"
            )

    @property
    def initial(self) -> Float[np.ndarray, "episodes numbers"]:
        """(Δ mm, φ rad) before the first period, of the wire, then of each catheter, as `simulate` takes them."""
        wire = np.column_stack([self.initial_inserted_length, self.initial_rotation])
        return np.concatenate([wire, self.catheter_initial.reshape(len(self), -1)], axis=1)

    @property
    def command(self) -> Float[np.ndarray, "episodes samples numbers"]:
        """Control that the drives were commanded (mm/s, rad/s): `control` and the slip, of the wire and each catheter.

        Simulated again it gives the same navigation to the bit, which `control` does not: a drive that pushes at one
        speed until it slips strains the wire otherwise than one that is slower from the start.
        """
        wire = commanded(self.control, np.stack([self.slip, self.rotation_slip], axis=-1), self.sample_period_s)
        slip = np.stack([self.catheter_slip, self.catheter_rotation_slip], axis=-1)
        others = commanded(self.catheter_control, slip, self.sample_period_s)
        return np.concatenate([wire, others.reshape(*wire.shape[:2], -1)], axis=-1)

    def select(self, episodes: Shaped[np.ndarray, "chosen"]) -> Dataset:
        """Return the chosen episodes, given as a mask or as indices."""
        names = [f.name for f in fields(self) if f.name not in ("folder", "manifest", "sample_period_s")]
        return replace(self, **{name: getattr(self, name)[episodes] for name in names})

    def of_split(self, split: str) -> Dataset:
        """Return the episodes of one split that are valid to the end.

        Raises:
            InputError: there are none.
        """
        chosen = (self.split == split) & self.valid.all(axis=1)
        if not chosen.any():
            held = ", ".join(sorted(set(self.split.tolist())))
            raise InputError(
                f"{self.folder}: no valid episode in split '{split}' (it has {held}); "
                "make the dataset with more anatomies or sequences"
            )
        return self.select(chosen)

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
        """Return the folder of an anatomy of the dataset.

        Raises:
            InputError: the anatomy is missing, or is another one than the dataset was made in.
        """
        record = self._record(name)
        folder = (self.folder / record["folder"]).resolve()
        if identify(folder) != (name, record["sha256"]):
            raise InputError(f"{folder}: is not the anatomy that {self.folder} was made in; make the dataset again")
        return folder


def commanded(
    control: Float[np.ndarray, "*n 2"], slip: Float[np.ndarray, "*n 2"], sample_period_s: float
) -> Float[np.ndarray, "*n 2"]:
    """Return the control that was commanded (mm/s, rad/s), from the motion of the drive and its slip (mm, rad)."""
    return (control + slip / sample_period_s).astype(control.dtype).astype(float)


def read_manifest(folder: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Read how a finished dataset was made, `meta/manifest.json`, and what it holds, `meta/info.json`.

    Raises:
        InputError: the folder holds no finished dataset, or one of another version.
    """
    if not (folder / MANIFEST_PATH).exists():
        if (folder / RECORD_FILE).exists():
            raise InputError(f"{folder}: the dataset is unfinished; run the same `endopilot dataset` command again")
        raise InputError(f"{folder}: no dataset here ({MANIFEST_PATH} is missing); make one with `endopilot dataset`")
    manifest = read_json(folder / MANIFEST_PATH, keys=("key", "settings"), mend=_MEND)
    with reading(folder / MANIFEST_PATH, _MEND):
        made = manifest["settings"].get("version")
        manifest["key"].encode()
        {record["name"]: record["sha256"] + record["folder"] for record in manifest["anatomies"]}
    if made != version():
        raise InputError(f"{folder}: made by {made}, which {version()} cannot read; make the dataset again")
    if not (folder / INFO_PATH).exists():
        raise InputError(
            f"{folder / INFO_PATH}: missing from the dataset; run the same `endopilot dataset` command again"
        )
    info = read_json(folder / INFO_PATH, keys=("features", "fps", "total_episodes", "total_frames"), mend=_MEND)
    if info.get("codebase_version") != LEROBOT_VERSION:
        found = info.get("codebase_version")
        raise InputError(f"{folder / INFO_PATH}: codebase_version is {found}, not {LEROBOT_VERSION}; make it again")
    return manifest, info


def load_dataset(folder: Path) -> Dataset:
    """Read a whole dataset made by `endopilot dataset`.

    Raises:
        InputError: the folder holds no finished dataset, or a file of it is missing, damaged or of another version.
    """
    with extra_named("reading a dataset"):
        import endopilot.dataset.parquet  # noqa: F401

    folder = Path(folder)
    manifest, info = read_manifest(folder)
    with reading(folder, _MEND):
        return _of_files(folder, manifest, info)


def _of_files(folder: Path, manifest: dict[str, Any], info: dict[str, Any]) -> Dataset:
    from endopilot.dataset.parquet import column_values, read_table

    samples, total = manifest["samples_per_episode"], info["total_episodes"]
    actuation, catheters = actuation_of(info["features"]), catheters_of(info["features"])
    episodes: dict[str, list[np.ndarray]] = {}
    signal: dict[str, np.ndarray] = {}
    filled = 0
    for number in range(manifest["files"]):
        data_path, episodes_path = paths_of_file(folder, number)
        table = read_table(episodes_path, manifest["key"])
        for name in table.column_names:
            episodes.setdefault(name, []).append(column_values(table, name))
        data = read_table(data_path, manifest["key"])
        if data.num_rows != table.num_rows * samples:
            raise InputError(
                f"{data_path}: {data.num_rows} rows where {table.num_rows * samples} belong; "
                "delete it and run `endopilot dataset` again"
            )
        end = filled + table.num_rows
        if end > total:
            break
        for name in signals(actuation, catheters):
            values = column_values(data, name)
            values = values.reshape(table.num_rows, samples, *values.shape[1:])
            if name not in signal:  # in place, so that a large dataset is never held twice
                signal[name] = np.empty((total, *values.shape[1:]), dtype=values.dtype)
            signal[name][filled:end] = values
        filled = end

    episode = {name: np.concatenate(parts) for name, parts in episodes.items()}
    if len(episode["episode_index"]) != total:
        raise InputError(
            f"{folder}: {len(episode['episode_index'])} episodes where {INFO_PATH} counts {total}; "
            "run `endopilot dataset` again"
        )
    state = signal["observation.state"]
    return Dataset(
        folder=folder,
        manifest=manifest,
        sample_period_s=1 / info["fps"],
        anatomy=episode["anatomy"].astype(str),
        sequence=episode["sequence"],
        split=episode["split"].astype(str),
        device=episode["device"].astype(str),
        friction=episode["friction"],
        tip_bend=episode["tip_bend_rad"],
        tip_stiffness_factor=episode["tip_stiffness_factor"],
        initial_inserted_length=episode["initial_inserted_length_mm"],
        initial_rotation=episode["initial_rotation_rad"],
        control=signal["velocity" if actuation == "force" else "action"][..., :2],
        inserted_length=state[..., 0],
        rotation=state[..., 1],
        tip_abscissa=state[..., 2],
        tip_offset=state[..., 3],
        tip_position=signal["tip_position_mm"],
        tip_direction=signal["tip_direction"],
        branch=signal["branch"],
        lumen_radius=signal["lumen_radius_mm"],
        contact_force_max=signal["contact_force_max_n"],
        contact_force_sum=signal["contact_force_sum_n"],
        base_force=signal["base_force_n"],
        base_torque=signal["base_torque_nmm"],
        drive_force=signal["drive_force_n"],
        drive_torque=signal["drive_torque_nmm"],
        slip=signal["slip_mm"],
        rotation_slip=signal["rotation_slip_rad"],
        valid=signal["valid"],
        **_of_catheters(episode, signal, catheters),
    )


def _of_catheters(
    episode: dict[str, np.ndarray], signal: dict[str, np.ndarray], catheters: int
) -> dict[str, np.ndarray]:
    """Return the fields of a `Dataset` that tell of its catheters."""
    prefixes = [f"catheter_{k + 1}_" for k in range(catheters)]
    names = (f"{prefix}initial_{name}" for prefix in prefixes for name in ("inserted_length_mm", "rotation_rad"))
    total, samples = signal["valid"].shape
    first = np.array([episode[name] for name in names]).reshape(2 * catheters, total).T
    state = signal["observation.state"][..., 4:].reshape(total, samples, catheters, 4)
    made = {
        "catheter_initial": first.reshape(total, catheters, 2),
        "catheter_control": signal["action"][..., 2:].reshape(total, samples, catheters, 2),
        "catheter_inserted_length": state[..., 0],
        "catheter_rotation": state[..., 1],
        "catheter_tip_abscissa": state[..., 2],
        "catheter_tip_offset": state[..., 3],
    }
    for name in OF_CATHETER:
        like = np.empty((total, samples, 0, *signal[name].shape[2:]), dtype=signal[name].dtype)
        parts = [like, *(signal[prefix + name][:, :, None] for prefix in prefixes)]
        made[f"catheter_{_plain(name)}"] = np.concatenate(parts, axis=2)
    return made


def _plain(column: str) -> str:
    """Return the name of a column without its unit."""
    return re.sub(r"_(mm|rad|n|nmm)$", "", column)
