"""A patient prepared for a device: push–pull envelopes of the wire, and the vessel's geometry, as tables.

A wire that is pushed lies on the outer side of every bend, one that is pulled on the inner side; its tip is then as far
behind or ahead of the proximal end as it can be. Between the two the tip stays where it is until the drive has taken up
the play. A few nominal wires, each at another rotation, are pushed to the end of the vessel and pulled back; the motion
of their tips is tabulated over the inserted length. The rod core does this once for a patient and a device, before the
first navigation.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
from jaxtyping import Bool, Float, Int

from endopilot.anatomy.tree import curvature_torsion, make_centerline
from endopilot.dataset.navigations import CAUGHT, STOP_SHORT_MM, branch_ends
from endopilot.devices.device import Wire
from endopilot.errors import InputError
from endopilot.files import json_text, writing
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.core import insertion_arguments
from endopilot.simulation.simulator import Simulator
from endopilot.types import Anatomy, Centerline, Insertion, VesselTree

WIRES = 16
"""Nominal wires, turned by equal angles."""
SPEED_MM_S = 10.0
"""Speed at which they are pushed and pulled; the rod core is quasi-static, so it matters little."""
STEP_MM = 1.0
"""Inserted lengths that the envelopes are kept at are this far apart."""
_PERIOD_S = 0.25
_PATIENCE = 8
"""Periods without motion after which a wire that is pulled counts as held by the vessel."""
_STILL_MM = 1e-3
_FORMAT_VERSION = 1


@dataclass(frozen=True, eq=False)
class Patient:
    """What the tips of nominal wires did when they were pushed in and pulled out, and what they lay in.

    Row k of the envelopes belongs to the wire turned by 2πk/wires; column g to the inserted length g · `STEP_MM`. A
    wire that came no farther keeps the slack and the offset of its last place.

    Attributes:
        push_tip: Δtip of the pushed wire, mm.
        pull_tip: Δtip of the pulled wire, mm.
        push_offset: γtip of the pushed wire, mm.
        pull_offset: γtip of the pulled wire, mm.
        deepest: largest inserted length of each wire, mm.
        leaf: row of `geometry` on which each wire came to its end.
        on_route: whether a branch lies on the path of a wire.
        leaf_of_branch: for each branch, a row of `geometry` that it lies on.
        geometry: for each path to a distal end, over the abscissa in steps of `STEP_MM`: curvature along the two
            transported normals and torsion (1/mm), radius (mm), integrals of curvature and of absolute torsion (rad),
            distance to the next branching point (mm).
        branch: branch at each place of `geometry`.
    """

    push_tip: Float[np.ndarray, "wires lengths"]
    pull_tip: Float[np.ndarray, "wires lengths"]
    push_offset: Float[np.ndarray, "wires lengths"]
    pull_offset: Float[np.ndarray, "wires lengths"]
    deepest: Float[np.ndarray, "wires"]
    leaf: Int[np.ndarray, "wires"]
    on_route: Bool[np.ndarray, "branches wires"]
    leaf_of_branch: Int[np.ndarray, "branches"]
    geometry: Float[np.ndarray, "leaves places 7"]
    branch: Int[np.ndarray, "leaves places"]


def prepare(anatomy: Anatomy, device: Wire, config: SimulatorConfig) -> Patient:
    """Push nominal wires into a vessel until each nears the end of a branch or is caught, and pull them out.

    A wire that the vessel holds against the drive's pull limit stays where it is.

    Raises:
        InputError: no wire could be simulated to the end.
    """
    simulator = Simulator(anatomy, device, worlds=WIRES, config=config)
    rotation = 2 * np.pi * np.arange(WIRES) / WIRES
    simulator.reset(inserted_length=np.zeros(WIRES), rotation=rotation, friction=np.full(WIRES, device.friction))
    ends = branch_ends(anatomy.tree)
    deepest = float(ends[np.isfinite(ends)].max()) - STOP_SHORT_MM
    pushing, rows = np.ones(WIRES, dtype=bool), []
    idle, before = np.zeros(WIRES, dtype=int), np.zeros(WIRES)
    while True:
        tip, inserted = simulator.project()[:, 0], simulator.inserted_length[:, 0]
        idle, before = np.where(~pushing & (inserted > before - _STILL_MM), idle + 1, 0), inserted.copy()
        rows.append((inserted.copy(), tip.abscissa, tip.offset, tip.branch, pushing))
        room = np.minimum(deepest - inserted, ends[tip.branch] - STOP_SHORT_MM - tip.abscissa)
        caught = simulator.base_load[:, 0, 0] > CAUGHT * device.push_limit_n
        pushing = pushing & (room > 1e-2) & ~caught & simulator.valid
        out = ~pushing & ((inserted <= 1e-6) | (idle >= _PATIENCE) | ~simulator.valid)
        if out.all():
            break
        pulled = np.where(out, 0.0, -np.minimum(SPEED_MM_S, inserted / _PERIOD_S))
        speed = np.where(pushing, np.clip(room / _PERIOD_S, 0.2, SPEED_MM_S), pulled)
        simulator.step(np.column_stack([speed, np.zeros(WIRES)]), _PERIOD_S)
    if not simulator.valid.all():
        raise InputError(
            f"{anatomy.name}: {int((~simulator.valid).sum())} of {WIRES} nominal wires could not be simulated to the "
            "end; check the anatomy, or take a finer simulator"
        )
    recorded = [np.array(values) for values in zip(*rows, strict=True)]
    inserted, branch = recorded[0], recorded[3]
    ended = branch[inserted.argmax(axis=0), np.arange(WIRES)]
    tree = anatomy.tree
    every = range(len(tree.branches))
    below = np.array([[b in tree.route(leaf) for leaf in tree.leaves()] for b in every])
    geometry, branches = _paths(anatomy)
    return Patient(
        **_tabulated(tree, recorded),
        deepest=inserted.max(axis=0),
        leaf=below.argmax(axis=1)[ended],
        on_route=np.array([[b in tree.route(int(end)) for end in ended] for b in every]),
        leaf_of_branch=below.argmax(axis=1),
        geometry=geometry,
        branch=branches,
    )


def _tabulated(tree: VesselTree, rows: Sequence[np.ndarray]) -> dict[str, Float[np.ndarray, "wires lengths"]]:
    """Return the envelopes of wires whose (inserted length, Δtip, γtip, branch, pushing) were recorded."""
    inserted, tip, offset, _, pushing = rows
    lengths = np.arange(0.0, float(tree.longest_path().abscissa[-1]) + 2 * STEP_MM, STEP_MM)
    names = ("push_tip", "pull_tip", "push_offset", "pull_offset")
    tables = {name: np.empty((inserted.shape[1], len(lengths))) for name in names}
    turn = pushing.sum(axis=0) - 1  # sample at which each wire is at its deepest
    for k, last in enumerate(turn):
        for motion, part in (("push", np.arange(last + 1)), ("pull", np.arange(last, len(inserted))[::-1])):
            at = inserted[part, k]
            tables[f"{motion}_tip"][k] = lengths - np.interp(lengths, at, at - tip[part, k])
            tables[f"{motion}_offset"][k] = np.interp(lengths, at, offset[part, k])
    return tables


def _paths(anatomy: Anatomy) -> tuple[Float[np.ndarray, "leaves places 7"], Int[np.ndarray, "leaves places"]]:
    """Return geometry and branch along the path to every distal end, at steps of `STEP_MM`."""
    places = np.arange(0.0, float(anatomy.tree.longest_path().abscissa[-1]) + 2 * STEP_MM, STEP_MM)
    tables, branches = [], []
    for leaf in anatomy.tree.leaves():
        path = anatomy.tree.path(leaf)
        line = make_centerline(path.points, path.radius, 0.0, first_normal(anatomy.insertion))
        route = anatomy.tree.route(leaf)
        ends = np.array([anatomy.tree.branches[b].centerline.abscissa[-1] for b in route])
        index = np.minimum(np.searchsorted(ends, places), len(route) - 1)
        ahead = np.maximum(ends[index] - places, 0.0)
        columns = [np.interp(places, path.abscissa, column) for column in _geometry_of(line)]
        tables.append(np.column_stack([*columns, ahead]))
        branches.append(np.array(route)[index])
    return np.stack(tables), np.stack(branches)


def _geometry_of(line: Centerline) -> list[Float[np.ndarray, "n"]]:
    """Return curvature along both transported normals, torsion, radius, and both integrals."""
    curvature, torsion = curvature_torsion(line)
    direction = np.gradient(line.points, line.abscissa, axis=0)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    bend = np.gradient(direction, line.abscissa, axis=0)
    size = np.maximum(np.linalg.norm(bend, axis=1, keepdims=True), 1e-9)
    bend = bend / size * curvature[:, None]
    second = np.cross(direction, line.normals)
    torsion = np.clip(torsion, -1.0, 1.0)
    step = np.diff(line.abscissa, prepend=line.abscissa[0])
    return [
        np.einsum("ij,ij->i", bend, line.normals),
        np.einsum("ij,ij->i", bend, second),
        torsion,
        line.radius,
        np.cumsum(curvature * step),
        np.cumsum(np.abs(torsion) * step),
    ]


def first_normal(insertion: Insertion) -> Float[np.ndarray, "3"]:
    """Return the first axis of a wire at the ostium that is not turned: the one its bent tip turns about."""
    w, x, y, z = insertion_arguments(insertion)["orientation"]
    return np.array([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)])


def read_or_prepare(
    folder: Path, name: str, identity: str, device: Wire, config: SimulatorConfig, read: Callable[[], Anatomy]
) -> Patient:
    """Return a patient prepared for a device: read from a folder, or prepared now and kept there.

    Args:
        folder: where patients are kept, one file for each patient and device.
        identity: SHA-256 of what the simulation depends on in the anatomy.

    Raises:
        InputError: the patient cannot be prepared, or the folder cannot be written.
    """
    settings = (
        identity,
        asdict(replace(config, threads=0)),
        asdict(device),
        WIRES,
        SPEED_MM_S,
        STEP_MM,
        _FORMAT_VERSION,
    )
    path = Path(folder) / f"{name}-{hashlib.sha256(json_text(settings).encode()).hexdigest()[:12]}.npz"
    names = [field.name for field in fields(Patient)]
    try:
        with np.load(path, allow_pickle=False) as stored:
            return Patient(**{name: stored[name] for name in names})
    except (OSError, ValueError, KeyError, BadZipFile):
        made = prepare(read(), device, config)
    with writing(path) as partial, partial.open("wb") as stream:
        np.savez_compressed(stream, **{name: getattr(made, name) for name in names})  # pyright: ignore[reportArgumentType]
    return made
