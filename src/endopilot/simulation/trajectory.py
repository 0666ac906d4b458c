"""What devices are simulated with and what they did, sample by sample: `SimulationSetUp`, `Step` and `Trajectory`.

=======================  ==========================================================================================
suffix                   content
=======================  ==========================================================================================
`.npz`                   everything, to the bit: one array a signal, as `Trajectory` names them, and `about`, JSON text
                         with each array's axes, unit and meaning, the devices, the settings and the identity of each
                         vessel. `numpy.load` opens it; `read_trajectory` reads it back, and it is replayed.
`.csv`, `.parquet`       a row for each world and sample, for people and other programs; columns end in their units
=======================  ==========================================================================================
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, Int, Shaped

from endopilot.devices.catheter import Catheter
from endopilot.devices.device import Wire
from endopilot.devices.stack import Stack, Transmission
from endopilot.errors import InputError
from endopilot.extras import extra_named
from endopilot.files import json_text, stored_arrays, writing
from endopilot.runs import Place
from endopilot.settings import public
from endopilot.simulation.config import Actuation, SimulatorConfig
from endopilot.simulation.motion import Motion, place
from endopilot.simulation.signals import SIGNALS, Step, described, table_columns
from endopilot.types import Anatomy, TipProjection

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure  # slow to import


@dataclass(frozen=True, eq=False)
class SimulationSetUp:
    """What worlds are simulated with: a `Simulator` made of it and the same commands give the same bits.

    Attributes:
        anatomies: the vessel of each world; `stacks` its devices.
        initial: Δ (mm) and φ (rad) that the devices are brought to before the first command; NaN in a world that was
            on its way already.
        friction: Coulomb coefficient of each device on the wall.
        actuation: what commands are: "velocity" (mm/s, rad/s) or "force" (N, N·mm).
        motion: how every vessel moves with time; None where they lie still.
    """

    anatomies: Sequence[Anatomy]
    stacks: Sequence[Stack]
    initial: Float[np.ndarray, "worlds devices 2"]
    friction: Float[np.ndarray, "worlds devices"]
    actuation: Actuation
    motion: Motion | None
    config: SimulatorConfig

    @property
    def largest(self) -> Float[np.ndarray, "worlds devices 2"]:
        """Largest magnitudes that commands may have: mm/s and rad/s, or N and N·mm, with a hair for rounding."""
        fastest = np.array([stack.fastest for stack in self.stacks]) * (1 + 1e-6)
        return np.full_like(fastest, np.finfo(float).max) if self.actuation == "force" else fastest


@dataclass(frozen=True, eq=False)
class SimulatorState:
    """All that the worlds' future depends on: restored, also in another process, they go on with the same bits.
    `values` is an array for each pair of anatomy and device, a row a world; `fingerprint` a hash of what it belongs to.
    """

    values: tuple[Float[np.ndarray, "_ _"], ...]
    fingerprint: str

    def write(self, path: Path | str) -> None:
        """Write the state to an .npz file, whole or not at all."""
        arrays = {f"values_{k}": v for k, v in enumerate(self.values)}
        with writing(Path(path)) as temporary, temporary.open("wb") as file:
            np.savez(file, fingerprint=np.array(self.fingerprint), **arrays)  # pyright: ignore[reportArgumentType]

    @staticmethod
    def read(path: Path | str) -> SimulatorState:
        """Read a state; InputError if the file is missing or is no saved state."""
        with stored_arrays(path, "saved state of a simulator", "write one with SimulatorState.write") as stored:
            count = sum(name.startswith("values_") for name in stored.files)
            return SimulatorState(tuple(stored[f"values_{k}"] for k in range(count)), str(stored["fingerprint"]))


WRITTEN = Place("file", (".parquet", ".csv", ".npz"))  # what a trajectory is written as
TRAJECTORY = "trajectory.npz"  # name of the file in a folder that holds one navigation or plan
FORMAT_VERSION = 1  # of the .npz file: raised when an array comes to mean something else
_FORMAT = "endopilot trajectory"
_REASONS = {1: "left the finite numbers", 2: "did not converge", 3: "went through the wall"}  # of an invalid world


@described
@dataclass(frozen=True, eq=False, kw_only=True)
class Trajectory(Step):
    """The recorded motion of the devices of simulated worlds, one sample every `period_s`.

    Sample t is the state at the end of period t, and `command[:, t]` held over that period. Device 0 is the wire; the
    catheters around it follow from the inside out. Positions and directions are those in the vessel as CT shows it.
    Unlike the force on one node, `wall_force` does not depend on the number of elements: neighbours share one contact.

    Attributes:
        set_up: what the worlds were simulated with.
        period_s: time between samples, s.
        tip: Δtip, γtip, branch and lumen radius at each sample.
        shape: positions of all nodes from the foremost tip to the base, LPS mm, if they were recorded; NaN beyond the
            nodes of a shorter wire.
        columns: further signals by name, such as those of a robot, a policy or a plan; `SIGNALS` describes them.
        about: what else is to be known, as plain JSON values.
    """

    set_up: SimulationSetUp
    period_s: float
    start: Float[np.ndarray, "worlds devices 2"]
    command: Float[np.ndarray, "worlds samples devices 2"]
    tip: TipProjection
    reason: Int[np.ndarray, "worlds"]
    shape: Float[np.ndarray, "worlds samples nodes 3"] | None = None
    vessel_to_laboratory: Float[np.ndarray, "worlds samples 3 4"] | None = None
    columns: dict[str, Shaped[np.ndarray, "worlds samples ..."]] = field(default_factory=dict)
    about: dict[str, Any] = field(default_factory=dict)

    @property
    def devices(self) -> int:
        """Number of devices."""
        return self.command.shape[2]

    @cached_property
    def proximal(self) -> Float[np.ndarray, "worlds samples devices 2"]:
        """Δ (mm) and φ (rad) at each sample."""
        return np.stack([self.inserted_length, self.rotation], axis=-1)

    @cached_property
    def control(self) -> Float[np.ndarray, "worlds samples devices 2"]:
        """π, what was made of the commands: mean dΔ/dt (mm/s) and dφ/dt (rad/s) over each period."""
        if self.set_up.actuation == "velocity":
            return self.command - np.stack([self.slip, self.rotation_slip], axis=-1) / self.period_s
        return np.diff(self.proximal, axis=1, prepend=self.start[:, None]) / self.period_s

    def why_invalid(self, world: int) -> str:
        """Return why and when a world became invalid, such as "did not converge after 12.5 s"."""
        seconds = self.period_s * float(np.argmin(self.valid[world]))
        return f"{_REASONS[int(self.reason[world])]} after {seconds:g} s"

    def replay(self, *, record_shape: bool | None = None, **changed: Any) -> Trajectory:
        """Simulate the same commands again from the same start; what nothing changes comes out the same to the bit.
        `changed` are attributes of `SimulationSetUp`. Raises InputError where a world was on its way already when the
        recording began, or its vessel is not given."""
        from endopilot.simulation.simulate import run_set_up  # which returns trajectories

        set_up = replace(self.set_up, **changed)
        if np.isnan(set_up.initial).any():
            raise InputError("replay: a world was on its way when the recording began; record from its start")
        if not set_up.anatomies:
            raise InputError("replay: the vessel is not given; read the trajectory with its anatomy")
        shape = self.shape is not None if record_shape is None else record_shape
        again = run_set_up(set_up, self.command, period_s=self.period_s, record_shape=shape)
        return replace(again, columns=self.columns, about=self.about)

    def plot(self, *, world: int = 0) -> Figure:
        """Draw Δ, Δtip, γtip and the wall force of one world over time, in a new figure of pyplot."""
        import matplotlib.pyplot as plt

        from endopilot.plotting import BLUE, CATHETER_COLORS, STYLE, VERMILLION  # slow to import

        colors = (BLUE, *CATHETER_COLORS)
        names = [device.name for device in self.set_up.stacks[world].devices]
        time_s = self.period_s * np.arange(1, self.command.shape[1] + 1)
        with plt.rc_context(STYLE):
            figure = plt.figure(figsize=(9, 6), layout="constrained")
            length, offset, force = figure.subplots(3, 1, sharex=True, height_ratios=(2, 1, 1))
            for k, (name, color) in enumerate(zip(names, colors, strict=False)):
                length.plot(time_s, self.inserted_length[world, :, k], color=color, ls="--", lw=1, label=f"Δ, {name}")
                length.plot(time_s, self.tip.abscissa[world, :, k], color=color, label=f"Δtip, {name}")
                offset.plot(time_s, self.tip.offset[world, :, k], color=color, label=f"γtip, {name}")
            force.plot(time_s, self.wall_force[world], color=VERMILLION, label="on 2 mm of the line")
            length.set(ylabel="inserted length Δ and\ntip along the vessel Δtip, mm")
            offset.set(ylabel="tip off the\ncenterline γtip, mm", ylim=(0, None))
            force.set(xlabel="time, s", ylabel="wall force, N", ylim=(0, None), xlim=(0, time_s[-1]))
            for axes in (length, offset, force):
                axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
        return figure

    def write(self, path: Path | str) -> None:
        """Write it as .npz, which `read_trajectory` reads back to the bit, or as a table, .csv or .parquet. Raises what
        `trajectory_suffix` does."""
        path, suffix = Path(path), trajectory_suffix(path, shape=self.shape is not None)
        with writing(path) as partial:
            if suffix == ".parquet":
                trajectory_table(self).to_parquet(partial, index=False)
            elif suffix == ".csv":
                trajectory_table(self).to_csv(partial, index=False)
            else:
                # what follows from others is left out, and further signals are marked as such
                found = {name: each for name, each in trajectory_signals(self).items() if name != "control"}
                arrays = {f"column.{name}" if name in self.columns else name: each for name, each in found.items()}
                with partial.open("wb") as stream:
                    np.savez_compressed(stream, about=np.array(_about(self, arrays)), **arrays)  # pyright: ignore[reportArgumentType]

    def samples(self, chosen: slice) -> Trajectory:
        """Return the trajectory with some of its samples; the first of them must be kept for it to be replayed."""
        kept: dict[str, Any] = {
            each.name: value[:, chosen]
            for each in fields(self)
            if each.name not in ("start", "reason") and isinstance(value := getattr(self, each.name), np.ndarray)
        }
        tip = TipProjection(**{name: each[:, chosen] for name, each in vars(self.tip).items()})
        columns = {name: each[:, chosen] for name, each in self.columns.items()}
        return replace(self, tip=tip, columns=columns, **kept)

    def every(self, count: int) -> Trajectory:
        """Return the trajectory with every so many-th sample: commands and controls are means over its periods."""
        ends = self.samples(slice(count - 1, None, count))

        def whole(values: np.ndarray) -> np.ndarray:
            kept = values[:, : count * (values.shape[1] // count)]
            return kept.reshape(len(values), -1, count, *values.shape[2:])

        return replace(
            ends,
            period_s=count * self.period_s,
            command=whole(self.command).mean(axis=2),
            slip=whole(self.slip).sum(axis=2),
            rotation_slip=whole(self.rotation_slip).sum(axis=2),
            iterations=whole(self.iterations).mean(axis=2),
            node_iterations=whole(self.node_iterations).sum(axis=2),
        )


def trajectory_suffix(path: Path | str, *, shape: bool) -> str:
    """Return the suffix that a trajectory is written by, in lower case. Raises InputError for another, or a table of
    wires' shapes, ModuleNotFoundError for .parquet without the extra `learn`."""
    WRITTEN.files(Path(path))
    suffix = Path(path).suffix.lower()
    if shape and suffix != ".npz":
        raise InputError(f"{path}: wire shapes do not fit a table; write them as .npz")
    if suffix == ".parquet":
        with extra_named(f"{path}"):
            import pyarrow  # noqa: F401  # with which pandas writes it
    return suffix


def trajectory_signals(trajectory: Trajectory) -> dict[str, np.ndarray]:
    """Return every array of a trajectory by its name in `SIGNALS`, and further ones by their own."""
    arrays: dict[str, np.ndarray] = {
        each.name: value
        for each in fields(trajectory)
        if isinstance(value := getattr(trajectory, each.name), np.ndarray)
    }
    arrays |= {f"tip_{name}": each for name, each in vars(trajectory.tip).items()}
    set_up = trajectory.set_up
    arrays |= {"initial": set_up.initial, "friction": set_up.friction, "control": trajectory.control}
    return arrays | trajectory.columns


def trajectory_table(trajectory: Trajectory) -> pd.DataFrame:
    """Return one row for each world and sample, as `table_columns` names them."""
    import pandas as pd

    worlds, samples = trajectory.valid.shape
    rows = (worlds, samples)
    found = {name: each for name, each in trajectory_signals(trajectory).items() if each.shape[:2] == rows}
    shown = {name: each for name, each in found.items() if name in SIGNALS and SIGNALS[name].columns}
    columns = {
        "world": np.repeat(np.arange(worlds), samples),
        "time_s": np.tile((np.arange(samples) + 1) * trajectory.period_s, worlds),
        **table_columns({name: each.reshape(-1, *each.shape[2:]) for name, each in shown.items()}),
    }
    if trajectory.vessel_to_laboratory is not None:
        there = place(trajectory.vessel_to_laboratory, trajectory.tip_position[:, :, 0])
        columns |= {f"tip_laboratory_{axis}_mm": there[..., i] for i, axis in enumerate("xyz")}
    columns |= {name: each for name, each in found.items() if name not in SIGNALS and each.shape == rows}
    return pd.DataFrame({name: np.asarray(values).reshape(-1) for name, values in columns.items()})


@public
def read_trajectory(path: str | Path, *, anatomy: Anatomy | Sequence[Anatomy] | None = None) -> Trajectory:
    """Read a trajectory from an .npz file; without its anatomy (of all worlds, or one for each) it is not replayed or
    plotted. Raises InputError for another file, version or vessel."""
    with stored_arrays(path, "trajectory", "give a file that Trajectory.write made") as stored:
        about = json.loads(str(stored["about"]))
        arrays = {name: stored[name] for name in stored.files if name != "about"}
        if about.get("format") != _FORMAT:
            raise KeyError("format")
    if about["version"] != FORMAT_VERSION:
        raise InputError(f"{path}: format version {about['version']}, not {FORMAT_VERSION}; simulate it again")
    missing = {each.name for each in fields(Step)} - arrays.keys()
    if missing:
        raise InputError(f"{path}: lacks {', '.join(sorted(missing))}, which this version records; simulate it again")
    vessels = _vessels(path, about, anatomy)
    made = [_stack(each) for each in about["stacks"]]
    set_up = SimulationSetUp(
        anatomies=vessels,
        stacks=[made[k] for k in about["stack_of_world"]],
        initial=arrays.pop("initial"),
        friction=arrays.pop("friction"),
        actuation=about["actuation"],
        motion=None if about["motion"] is None else Motion(**about["motion"]),
        config=SimulatorConfig(**about["config"]),
    )
    tip = TipProjection(**{name: arrays.pop(f"tip_{name}") for name in TipProjection.__dataclass_fields__})
    names = {each.name for each in fields(Trajectory)}
    own = {name: values for name, values in arrays.items() if name in names}
    columns = {name.removeprefix("column."): values for name, values in arrays.items() if name.startswith("column.")}
    return Trajectory(set_up=set_up, period_s=about["period_s"], tip=tip, columns=columns, about=about["about"], **own)


def _about(trajectory: Trajectory, arrays: Mapping[str, np.ndarray]) -> str:
    set_up = trajectory.set_up
    meaning = {name: SIGNALS.get(name.removeprefix("column.")) for name in arrays}
    stacks = list({id(stack): stack for stack in set_up.stacks}.values())
    number = {id(stack): k for k, stack in enumerate(stacks)}
    content = {
        "format": _FORMAT,
        "version": FORMAT_VERSION,
        "period_s": trajectory.period_s,
        "arrays": {
            name: {"axes": each.axes, "unit": each.unit, "meaning": each.meaning}
            for name, each in meaning.items()
            if each is not None
        },
        "actuation": set_up.actuation,
        "motion": None if set_up.motion is None else asdict(set_up.motion),
        "config": asdict(set_up.config),
        "stacks": [asdict(stack) for stack in stacks],
        "stack_of_world": [number[id(stack)] for stack in set_up.stacks],
        "anatomies": [{"name": vessel.name, "identity": vessel.identity} for vessel in set_up.anatomies],
        "about": trajectory.about,
    }
    return json_text(content)


def _stack(described: Mapping[str, Any]) -> Stack:
    catheters = tuple(Catheter(**each) for each in described["catheters"])
    behind = tuple(Transmission(**each) for each in described.get("transmissions", ()))
    return Stack(Wire(**described["wire"]), catheters, behind)


def _vessels(path: Path | str, about: Mapping[str, Any], anatomy: Anatomy | Sequence[Anatomy] | None) -> list[Anatomy]:
    wanted = about["anatomies"]
    if anatomy is None:
        return []
    given = [anatomy] * len(wanted) if isinstance(anatomy, Anatomy) else list(anatomy)
    for world, each in enumerate(wanted):
        if world >= len(given) or given[world].identity != each["identity"]:
            raise InputError(f"{path}: world {world} is of another vessel, {each['name']!r}; give that anatomy")
    return given
