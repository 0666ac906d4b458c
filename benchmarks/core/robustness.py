"""Failures of the rod core in many rollouts beyond normal use: `measure_robustness`.

Every device is driven through every anatomy that it fits, synthetic ones or given ones, with four kinds of controls in
equal shares: random within the vessel, random beyond its end, pushed against its end, and random and then pulled out. A
chunk is one anatomy and one device, or a pair of a wire and a catheter around it, each with a drive of its own. It runs
in a separate process, so that a crash is counted and survived, and writes one small file. An interrupted run goes on
with the missing chunks.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Iterator
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, dataclass, fields
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from jaxtyping import Bool, Float, Int

from benchmarks.core.manoeuvres import MANOEUVRES, paired_controls, seed_of, stacks_of
from benchmarks.figures import Bar
from endopilot import _core
from endopilot.anatomy.io import read_anatomy
from endopilot.atlas.atlas import AtlasConfig, make_patient
from endopilot.devices.catheter import list_catheters, read_catheter
from endopilot.devices.device import read_wire
from endopilot.devices.device_files import list_wires
from endopilot.devices.stack import Stack
from endopilot.errors import InputError
from endopilot.files import read_json, sha256, write_json, writing
from endopilot.parallel import Workers
from endopilot.progress import progress
from endopilot.runs import claim
from endopilot.settings import Within, settings
from endopilot.simulation.config import SimulatorConfig, wall_stiffness
from endopilot.simulation.simulate import WALL_FORCE_LIMIT_N, simulate
from endopilot.simulation.trajectory import Trajectory
from endopilot.types import SAMPLE_PERIOD_S, Anatomy

MOST_INVALID_SHARE = 1e-3
"""Bar: share of the worlds that may be invalid."""
MOST_PENETRATION_MM = 0.05
"""Bar: 99.9th percentile of the penetration over all valid samples, mm."""


@settings
class RobustnessConfig:
    """Number and length of the rollouts, the anatomies, and the folder of the results."""

    rollouts: Annotated[int, Within(1, 10**7)] = 10_000
    """Number of rollouts, spread over the anatomies and the devices that fit; rounded up to whole chunks."""
    anatomies: Annotated[int, Within(1, 100000)] = 100
    """Number of synthetic anatomies, if none are given."""
    given: tuple[Path, ...] = ()
    """Folders of anatomies of your own, made by `endopilot anatomy`."""
    catheters: bool = False
    """Put a catheter around each wire: five random pairs of shipped ones for each anatomy."""
    seed: Annotated[int, Within(0, 2**63 - 1)] = 0
    """Seed of the anatomies and the controls."""
    seconds: Annotated[float, Within(5, 3600)] = 60.0
    """Length of a rollout, s."""
    threads: Annotated[int, Within(0, 1024)] = 0
    """Threads of the rod core; 0 for one a processor core. The results do not depend on it."""
    folder: Path = Path("runs/bench-robustness")
    """Folder of the chunks' results; an interrupted run goes on where it stopped."""


@dataclass(frozen=True, eq=False)
class Chunk:
    """Results of the rollouts of one anatomy and one device; one file on disk.

    Attributes:
        penetration_mm: depth of the deepest node in the wall, mm: its contact force over the wall's stiffness.
        base_force_n: force of the drive, N, positive where it pushes.
        base_torque_n_mm: torque of the drive, N·mm.
        over_limit: force of the drive as a share of its limit, of the drive that is nearest to its limit.
        wall_force_n: largest resultant of the wall's forces on 2 mm of the wire, N.
        wedged: whether a device has come through a lumen that is no wider than itself.
        valid: whether the world was valid.
        non_finite: numbers of each rollout that are not finite though its world was valid.
        seconds: processor time that the chunk took, s.
    """

    penetration_mm: Float[np.ndarray, "rollouts samples"]
    base_force_n: Float[np.ndarray, "rollouts samples"]
    base_torque_n_mm: Float[np.ndarray, "rollouts samples"]
    over_limit: Float[np.ndarray, "rollouts samples"]
    wall_force_n: Float[np.ndarray, "rollouts samples"]
    wedged: Bool[np.ndarray, "rollouts samples"]
    valid: Bool[np.ndarray, "rollouts samples"]
    non_finite: Int[np.ndarray, "rollouts"]
    seconds: float


def measure_robustness(config: RobustnessConfig = RobustnessConfig()) -> dict[str, Any]:
    """Drive every shipped device through many anatomies and beyond their ends, and count failures.

    The anatomies are synthetic, or those given. Only the missing rollouts are simulated.

    Returns:
        `figures`, one row a bar: figure, value, bar, passed; `rollouts` and `simulated_hours`; `by_device`,
        `by_manoeuvre` and `by_anatomy`, of each the invalid worlds, the penetration's 99.9th percentile and maximum
        (mm), that percentile where no device has come through a lumen narrower than itself, and the share of the
        samples in which one has (`wedged_share`), the largest share of its limit that a drive's force came to and the
        share of samples beyond 1.06 of it, the drive's largest push, pull (N) and torque (N·mm), the largest wall force
        (N) and the worlds in which it exceeds its limit; `invalid_worlds` and `crashed`, one sentence each: reason,
        anatomy, device, rollout, seconds.

    Raises:
        InputError: the folder belongs to another run, such as one of another build of the core, or cannot be written;
            a given folder holds no anatomy.
    """
    claim(config.folder, "python -m benchmarks robustness", **_identity(config))
    anatomies = len(config.given) or config.anatomies
    share = -(-config.rollouts // anatomies)
    with progress("Rollouts", total=anatomies * len(_stacks(config, 0))) as advance, _Worker() as worker:
        for index in range(anatomies):
            stacks = _stacks(config, index)
            for place, stack in enumerate(stacks):
                # the remainder of the share falls to other devices in each anatomy
                count = (share + (place + index) % len(stacks)) // len(stacks)
                path = _path(config, index, stack)
                if count > 0 and not _done(path):
                    worker.run(path, config, index, stack, count)
                advance(remark=f"{stack.name}, anatomy {index}")
    return _summarise(config)


def run_chunk(path: Path, config: RobustnessConfig, index: int, stack: Stack, rollouts: int) -> None:
    """Simulate the rollouts of one anatomy and one device or pair, and write the results to `path` and beside it.

    Args:
        path: file of the chunk, `.npz`; a `.json` of the same name lists the invalid worlds.
        config: length, seed and threads.
        index: number of the anatomy.
        stack: the wire, and the catheter around it if there is one.
        rollouts: number of rollouts.
    """
    anatomy = _anatomy(config, index)
    try:
        stack.check(anatomy)
    except InputError as error:
        write_json(path.with_suffix(".json"), {"anatomy": anatomy.name, "misfit": str(error)})
        return
    began = time.process_time()
    samples = round(config.seconds / SAMPLE_PERIOD_S)
    seed = seed_of(index, seed=config.seed)
    initial, control = paired_controls(anatomy, stack, rollouts=rollouts, samples=samples, seed=seed)
    simulator = SimulatorConfig(threads=config.threads)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # invalid worlds are listed below, each with its reason
        rollout = simulate(anatomy, stack, control, initial=initial, config=simulator)
    chunk = _describe(anatomy, stack, rollout, simulator, time.process_time() - began)
    invalid = [
        f"{anatomy.name}, {stack.name}, rollout {world} ({MANOEUVRES[world % len(MANOEUVRES)]}): "
        + rollout.why_invalid(world)
        for world in np.flatnonzero(rollout.reason).tolist()
    ]
    with writing(path) as partial:
        np.savez_compressed(partial, **{field.name: getattr(chunk, field.name) for field in fields(chunk)})
    write_json(path.with_suffix(".json"), {"anatomy": anatomy.name, "invalid": invalid})


_OF_DEVICES = (
    "tip_position",
    "tip_direction",
    "base_force",
    "base_torque",
    "slip",
    "rotation_slip",
    "inserted_length",
    "rotation",
)


def _describe(anatomy: Anatomy, stack: Stack, rollout: Trajectory, config: SimulatorConfig, seconds: float) -> Chunk:
    wall_n_mm = wall_stiffness(config, stack.push_limit_n)
    of_all = [getattr(rollout, name) for name in ("contact_force_max", "contact_force_sum", "wall_force")]
    of_devices = [getattr(rollout, name) for name in _OF_DEVICES]
    of_wire = [getattr(rollout.tip, name)[:, :, 0] for name in ("abscissa", "offset", "radius")]
    rows = rollout.valid.shape
    numbers = np.concatenate([each.reshape(*rows, -1) for each in (*of_all, *of_devices, *of_wire)], axis=-1)
    force, torque = rollout.base_force, rollout.base_torque
    most = [[device.push_limit_n, -device.pull_limit_n] for device in stack.devices]
    bad = (~np.isfinite(numbers) & rollout.valid[..., None]).sum(axis=(1, 2))
    return Chunk(
        penetration_mm=(rollout.contact_force_max / wall_n_mm).astype(np.float32),
        base_force_n=_largest(force).astype(np.float32),
        base_torque_n_mm=_largest(torque).astype(np.float32),
        over_limit=(force[..., None] / most).max(axis=(-2, -1)).astype(np.float32),
        wall_force_n=rollout.wall_force.astype(np.float32),
        wedged=_wedged(anatomy, stack, rollout),
        valid=rollout.valid,
        non_finite=bad,
        seconds=seconds,
    )


def _wedged(anatomy: Anatomy, stack: Stack, rollout: Trajectory) -> Bool[np.ndarray, "rollouts samples"]:
    at = rollout.tip
    narrowest = np.full(at.branch.shape, np.inf)
    for branch in np.unique(at.branch).tolist():
        path, here = anatomy.tree.path(branch), at.branch == branch
        so_far = np.concatenate([[np.inf], np.minimum.accumulate(path.radius)])
        narrowest[here] = so_far[np.searchsorted(path.abscissa, at.abscissa[here], side="right")]
    return np.any(narrowest <= [device.tip_radius_mm for device in stack.devices], axis=-1)


def _largest(loads: Float[np.ndarray, "rollouts samples drives"]) -> Float[np.ndarray, "rollouts samples"]:
    """Return the load of the drive that bears most."""
    most = np.abs(np.nan_to_num(loads)).argmax(axis=-1)
    return np.take_along_axis(loads, most[..., None], axis=-1)[..., 0]


@lru_cache(maxsize=1)
def _anatomy(config: RobustnessConfig, index: int) -> Anatomy:
    return read_anatomy(config.given[index]) if config.given else make_patient(AtlasConfig(seed=config.seed), index)


class _Worker:
    """A process that simulates chunks; it is replaced when it dies."""

    def __enter__(self) -> _Worker:
        self._pool: Workers | None = None
        return self

    def __exit__(self, *_: object) -> None:
        if self._pool is not None:
            self._pool.stop()

    def run(self, path: Path, config: RobustnessConfig, index: int, stack: Stack, rollouts: int) -> None:
        """Simulate a chunk; if that raises or ends the process, record the chunk as crashed.

        Raises:
            InputError: the folder cannot be written.
        """
        if self._pool is None:
            self._pool = Workers(1)
        try:
            self._pool.submit(run_chunk, path, config, index, stack, rollouts).result()
        except InputError:
            raise
        except Exception as error:  # a crash is what is being counted
            what = "the process died" if isinstance(error, BrokenProcessPool) else f"{type(error).__name__}: {error}"
            name = config.given[index].name if config.given else f"patient {index}"
            write_json(path.with_suffix(".json"), {"anatomy": name, "crash": f"{name}, {stack.name}: {what}"})
            self._pool.shutdown(wait=False)
            self._pool = None


def _stacks(config: RobustnessConfig, index: int) -> list[Stack]:
    return stacks_of(index, seed=config.seed, catheters=config.catheters)


def _path(config: RobustnessConfig, index: int, stack: Stack) -> Path:
    return Path(config.folder) / f"{index:04d}-{'-'.join(device.name for device in stack.devices)}.npz"


def _done(path: Path) -> bool:
    return path.with_suffix(".json").exists()  # written last


def _identity(config: RobustnessConfig) -> dict[str, Any]:
    """Return what the results of the chunks follow from."""
    devices = [read_wire(name) for name in list_wires()]
    catheters = [read_catheter(name) for name in list_catheters() if config.catheters]
    return {
        "config": {name: value for name, value in asdict(config).items() if name not in ("threads", "folder", "given")},
        "given": [read_anatomy(folder).identity for folder in config.given],
        "devices": {device.name: device for device in devices},
        "catheters": {catheter.name: catheter for catheter in catheters},
        "core_sha256": sha256(Path(_core.__file__)),
    }


def _summarise(config: RobustnessConfig) -> dict[str, Any]:
    tallies: dict[tuple[str, str], _Tally] = {}
    groupings = ("by_device", "by_manoeuvre", "by_anatomy")
    invalid, crashed, misfits = [], [], []
    non_finite, seconds = 0, 0.0
    for stack, record, chunk in _results(config):
        invalid.extend(record.get("invalid", []))
        crashed.extend([record["crash"]] if "crash" in record else [])
        misfits.extend([record["misfit"]] if "misfit" in record else [])
        if chunk is None:
            continue
        non_finite += int(chunk.non_finite.sum())
        seconds += float(chunk.seconds)
        kind = np.arange(len(chunk.valid)) % len(MANOEUVRES)
        groups = [("all", "all", slice(None)), ("by_device", stack.name, slice(None))]
        groups += [("by_anatomy", record["anatomy"], slice(None))]
        groups += [("by_manoeuvre", name, kind == place) for place, name in enumerate(MANOEUVRES)]
        for group, name, rows in groups:
            tally = tallies.setdefault((group, name), _Tally())
            tally.add(chunk, rows)
    everything = tallies.get(("all", "all"), _Tally()).row()
    worlds = everything["rollouts"]
    return {
        "figures": [
            Bar(MOST_INVALID_SHARE).row("invalid worlds, share", everything["invalid"] / worlds if worlds else 0.0),
            Bar(MOST_PENETRATION_MM).row(
                "penetration, 99.9th percentile, mm", everything["penetration_p999_mm"] or 0.0
            ),
            Bar(0).row("non-finite numbers in valid worlds", non_finite),
            Bar(0).row("crashes", len(crashed)),
        ],
        **everything,
        "simulated_hours": round(worlds * config.seconds / 3600, 2),
        "realtime_factor": round(worlds * config.seconds / seconds, 1) if seconds else None,
        **{of: {name: t.row() for (group, name), t in tallies.items() if group == of} for of in groupings},
        "invalid_worlds": invalid,
        "crashed": crashed,
        "did_not_fit": misfits,
    }


def _results(config: RobustnessConfig) -> Iterator[tuple[Stack, dict[str, Any], Chunk | None]]:
    """Yield the devices, the record and the arrays of every chunk on disk."""
    for index in range(len(config.given) or config.anatomies):
        for stack in _stacks(config, index):
            path = _path(config, index, stack)
            if not _done(path):
                continue
            chunk = None
            if path.exists():
                with np.load(path) as arrays:
                    chunk = Chunk(
                        **{name: arrays[name] if arrays[name].ndim else arrays[name].item() for name in arrays.files}
                    )
            yield stack, read_json(path.with_suffix(".json")), chunk


class _Tally:
    """Penetrations, forces and validity of a group of rollouts."""

    def __init__(self) -> None:
        self.rollouts = self.invalid = self.pressing = 0
        self.push = self.pull = self.torque = self.wall = 0.0
        self.penetration: list[np.ndarray] = []
        self.over_limit: list[np.ndarray] = []
        self.wedged: list[np.ndarray] = []

    def add(self, chunk: Chunk, rows: Any) -> None:
        valid = chunk.valid[rows]
        self.rollouts += len(valid)
        self.invalid += int((~valid.all(axis=1)).sum())
        self.penetration.append(chunk.penetration_mm[rows][valid])
        self.over_limit.append(chunk.over_limit[rows][valid])
        self.wedged.append(chunk.wedged[rows][valid])
        force, torque = chunk.base_force_n[rows][valid], chunk.base_torque_n_mm[rows][valid]
        wall = np.where(valid, chunk.wall_force_n[rows], 0.0)
        self.push = max(self.push, float(force.max(initial=0.0)))
        self.pull = max(self.pull, float(-force.min(initial=0.0)))
        self.torque = max(self.torque, float(np.abs(torque).max(initial=0.0)))
        self.wall = max(self.wall, float(wall.max(initial=0.0)))
        self.pressing += int((wall > WALL_FORCE_LIMIT_N).any(axis=1).sum())

    def row(self) -> dict[str, Any]:
        depth = np.concatenate(self.penetration) if self.penetration else np.zeros(0)
        if len(depth) == 0:
            return {"rollouts": self.rollouts, "invalid": self.invalid, "penetration_p999_mm": None}
        over_limit, wedged = np.concatenate(self.over_limit), np.concatenate(self.wedged)
        free = depth[~wedged]
        return {
            "rollouts": self.rollouts,
            "invalid": self.invalid,
            "penetration_p99_mm": round(float(np.percentile(depth, 99)), 4),
            "penetration_p999_mm": round(float(np.percentile(depth, 99.9)), 4),
            "penetration_max_mm": round(float(depth.max()), 4),
            "penetration_p999_where_devices_fit_mm": round(float(np.percentile(free, 99.9)), 4) if len(free) else None,
            "wedged_share": round(float(wedged.mean()), 5),
            "share_deeper_than_bar": round(float((depth > MOST_PENETRATION_MM).mean()), 5),
            "drive_over_limit_max": round(float(over_limit.max()), 3),
            "share_over_limit_by_6_percent": round(float((over_limit > 1.06).mean()), 6),
            "largest_push_n": round(self.push, 3),
            "largest_pull_n": round(self.pull, 3),
            "largest_torque_n_mm": round(self.torque, 3),
            "largest_wall_force_n": round(self.wall, 3),
            "wall_force_worlds": self.pressing,
        }
