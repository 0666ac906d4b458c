"""Trajectories as files and tables.

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
from dataclasses import asdict, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any
from zipfile import BadZipFile

import numpy as np

from endopilot.devices.catheter import Catheter
from endopilot.devices.device import Wire
from endopilot.devices.stack import Stack, Transmission
from endopilot.errors import InputError
from endopilot.extras import extra_named
from endopilot.files import json_text, regular, writing
from endopilot.settings import public
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.motion import Motion, place
from endopilot.simulation.set_up import SimulationSetUp
from endopilot.simulation.signals import SIGNALS, SolvedOutputs, table_columns
from endopilot.simulation.trajectory import Trajectory
from endopilot.types import Anatomy, TipProjection

if TYPE_CHECKING:
    import pandas as pd

TRAJECTORY = "trajectory.npz"
"""Name of the file in a folder that holds one navigation or plan."""
FORMAT_VERSION = 1
"""Of the .npz file: raised when an array comes to mean something else."""


def trajectory_signals(trajectory: Trajectory) -> dict[str, np.ndarray]:
    """Return every array of a trajectory by its name in `SIGNALS`, and further ones by their own."""
    arrays: dict[str, np.ndarray] = {
        each.name: value
        for each in fields(trajectory)
        if isinstance(value := getattr(trajectory, each.name), np.ndarray)
    }
    arrays |= {f"tip_{name}": getattr(trajectory.tip, name) for name in TipProjection.__dataclass_fields__}
    set_up = trajectory.set_up
    arrays |= {"initial": set_up.initial, "friction": set_up.friction, "control": trajectory.control}
    return arrays | trajectory.columns


def trajectory_table(trajectory: Trajectory) -> pd.DataFrame:
    """Return one row for each world and sample; column names end in their units where they have one.

    Columns of the wire have plain names; those of catheters begin with `catheter_1_` and `catheter_2_`.
    """
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


def write_trajectory(trajectory: Trajectory, path: Path) -> None:
    """Write a trajectory as the module describes, whole or not at all.

    Raises:
        InputError: another suffix, or shapes for a table.
        ModuleNotFoundError: .parquet without the extra `learn`.
    """
    path = Path(path)
    if path.suffix not in (".parquet", ".csv", ".npz"):
        raise InputError(f"{path}: a trajectory is written as .parquet, .csv or .npz; choose one of these suffixes")
    if trajectory.shape is not None and path.suffix != ".npz":
        raise InputError(f"{path}: wire shapes do not fit a table; write them as .npz")
    if path.suffix == ".parquet":
        with extra_named(f"{path}"):
            pass  # with which pandas writes it
    with writing(path) as partial:
        if path.suffix == ".parquet":
            trajectory_table(trajectory).to_parquet(partial, index=False)
        elif path.suffix == ".csv":
            trajectory_table(trajectory).to_csv(partial, index=False)
        else:
            arrays = _arrays(trajectory)
            with partial.open("wb") as stream:
                np.savez_compressed(stream, about=np.array(_about(trajectory, arrays)), **arrays)  # pyright: ignore[reportArgumentType]


@public
def read_trajectory(path: str | Path, *, anatomy: Anatomy | Sequence[Anatomy] | None = None) -> Trajectory:
    """Read a trajectory from an .npz file.

    Args:
        path: the file.
        anatomy: the vessel of all worlds, or one for each; without it the trajectory is not replayed or plotted.

    Raises:
        InputError: no such file, or one that is no trajectory, of another version, or of another vessel.
    """
    try:
        with np.load(regular(path), allow_pickle=False) as stored:
            about = json.loads(str(stored["about"]))
            arrays = {name: stored[name] for name in stored.files if name != "about"}
        if about.get("format") != _FORMAT:
            raise KeyError("format")
    except (OSError, ValueError, KeyError, BadZipFile, AttributeError, TypeError) as error:
        raise InputError(f"{path}: no trajectory ({error}); give a file that Trajectory.write made") from None
    if about["version"] != FORMAT_VERSION:
        raise InputError(f"{path}: format version {about['version']}, not {FORMAT_VERSION}; simulate it again")
    missing = {each.name for each in fields(SolvedOutputs)} - arrays.keys()
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


_FORMAT = "endopilot trajectory"


def _arrays(trajectory: Trajectory) -> dict[str, np.ndarray]:
    """Return the arrays of a file: what follows from others is left out, and further signals are marked as such."""
    found = trajectory_signals(trajectory)
    del found["control"]
    return {f"column.{name}" if name in trajectory.columns else name: each for name, each in found.items()}


def _about(trajectory: Trajectory, arrays: Mapping[str, np.ndarray]) -> str:
    """Return what the arrays mean and what they were simulated with, as JSON."""
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
