"""Proximal controls: random navigations, and scripted ones from a CSV file.

A control π is the mean velocity (dΔ/dt mm/s, dφ/dt rad/s) over one sample period of 0.5 s.
"""

from __future__ import annotations

import re
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from jaxtyping import Float, Int

from endopilot.devices.drive_limits import within_travel
from endopilot.devices.stack import column_prefixes
from endopilot.errors import InputError, Remark
from endopilot.settings import Share, Within, settings
from endopilot.simulation.checks import check_memory
from endopilot.simulation.csv_file import Columns, read_columns
from endopilot.types import SAMPLE_PERIOD_S

_COLUMNS = ("time_s", "translation_mm_s", "rotation_rad_s")
PERIODS_S = (1e-3, 4.0)
"""How long a control of a file may hold, s: drives take a command a millisecond at best, and nobody drives blindly for
longer."""
_KINDS, _SHARES = ("insertion", "retraction", "spin", "pause"), (0.45, 0.3, 0.15)  # the rest of the manoeuvres pauses
_ROTATES = 0.6  # share of the pushing and pulling manoeuvres that rotate too
_LASTS_S = (1.0, 6.0)  # a manoeuvre, s
_DRIVE = 2**32  # from the key of a navigation's wire to that of its catheter; no study has that many navigations


@settings
class ControlConfig:
    """Random navigations: manoeuvres of random kind, length and speed, joined smoothly."""

    max_velocity_mm_s: Annotated[float, Within(0, 1000)] = 12.0
    """Fastest translation, mm/s."""
    max_rotation_rad_s: Annotated[float, Within(0, 1000)] = 3.0
    """Fastest rotation, rad/s."""
    first_inserted_length_mm: Annotated[float, Within(0, 5000)] = 5.0
    """Least inserted length that a navigation starts with, mm."""
    start_spread: Share = 0.6
    """Starts are spread from there over this share of the largest inserted length."""


def random_controls(
    config: ControlConfig,
    *,
    n_sequences: int,
    n_samples: int,
    seed: int,
    max_inserted_length_mm: float,
    first: int = 0,
    devices: int = 1,
) -> tuple[Float[np.ndarray, "n devices 2"], Float[np.ndarray, "n samples devices 2"]]:
    """Draw random navigations, each the same whatever `n_sequences`, from number `first`; return their start (Δ mm, φ
    rad) and controls (mm/s, rad/s) of each device, driven independently. Inserted lengths lie between 0 and
    `max_inserted_length_mm`. Raises InputError for a number that is not positive."""
    if n_sequences < 1 or n_samples < 1:
        raise InputError(f"random controls: {n_sequences} sequences of {n_samples} samples; give at least 1 of 1")
    if not 0 <= seed < 2**64:
        raise InputError(f"seed: {seed}; give a whole number from 0 to 2^64 - 1")
    if not 0 < max_inserted_length_mm < np.inf:
        raise InputError(f"max_inserted_length_mm: {max_inserted_length_mm}; give a positive length")
    check_memory(
        4 * 16 * n_sequences * n_samples * devices,  # drawn, smoothed, clipped and simulated
        f"{n_sequences} sequences of {n_samples} samples",
        "draw fewer, or shorter ones",
    )
    initial, control = np.empty((n_sequences, devices, 2)), np.empty((n_sequences, n_samples, devices, 2))
    for index, drive in np.ndindex(n_sequences, devices):
        key = np.array([seed, first + index + drive * _DRIVE], dtype=np.uint64)
        generator = np.random.Generator(np.random.Philox(key=key))
        start, driven = _navigation(config, generator, n_samples, max_inserted_length_mm)
        initial[index, drive], control[index, :, drive] = start, driven
    inserted = initial[..., 0].copy()
    for sample in np.moveaxis(control, 1, 0):
        sample[..., 0] = within_travel(
            sample[..., 0], inserted, SAMPLE_PERIOD_S, travel_mm=(0.0, max_inserted_length_mm)
        )
        inserted += sample[..., 0] * SAMPLE_PERIOD_S
    return initial, control


def free_wire_load(
    velocity: Float[np.ndarray, "*n 2"], *, radius_mm: float, friction_n: float, drag_n_s_mm: float, stick_mm_s: float
) -> Float[np.ndarray, "*n 2"]:
    """Return the drive's force (N) and torque (N·mm) that move a wire through the introducer alone at (Δ̇ mm/s, φ̇
    rad/s): its surface's v = (Δ̇, r φ̇) is opposed by F v / √(v² + ε²) + c v, as in the rod core."""
    surface = velocity * np.array([1.0, radius_mm])
    size = np.sqrt((surface**2).sum(axis=-1, keepdims=True) + stick_mm_s**2)
    return (friction_n / size + drag_n_s_mm) * surface * np.array([1.0, radius_mm])


def _navigation(
    config: ControlConfig, generator: np.random.Generator, n_samples: int, longest: float
) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "samples 2"]]:
    first = min(config.first_inserted_length_mm, longest)
    inserted = generator.uniform(first, first + config.start_spread * (longest - first))
    initial = np.array([inserted, generator.uniform(-np.pi, np.pi)])
    wanted = np.zeros((n_samples + 2, 2))
    at = 0
    while at < len(wanted):
        samples = max(1, round(generator.uniform(*_LASTS_S) / SAMPLE_PERIOD_S))
        wanted[at : at + samples] = _manoeuvre(config, generator)
        at += samples
    smooth = 0.25 * wanted[:-2] + 0.5 * wanted[1:-1] + 0.25 * wanted[2:]  # ramps of one period between manoeuvres
    return initial, smooth


def _manoeuvre(config: ControlConfig, generator: np.random.Generator) -> Float[np.ndarray, "2"]:
    """Return the mean velocities of one manoeuvre; always draws the same number of random numbers."""
    kind = _KINDS[int(np.searchsorted(np.cumsum(_SHARES), generator.random(), side="right"))]
    speed, turns, spin = generator.random(), generator.random() < _ROTATES, generator.uniform(-1, 1)
    translation = {"insertion": 1.0, "retraction": -1.0}.get(kind, 0.0) * (0.15 + 0.85 * speed)
    rotation = spin if kind == "spin" or (turns and kind != "pause") else 0.0
    return np.array([translation * config.max_velocity_mm_s, rotation * config.max_rotation_rad_s])


@dataclass(frozen=True, eq=False)
class ScriptedControls:
    """A file's controls: start (Δ mm, φ rad) and velocities (mm/s, rad/s) of each world and device, `period_s` each."""

    initial: Float[np.ndarray, "worlds devices 2"]
    control: Float[np.ndarray, "worlds samples devices 2"]
    period_s: float


def read_controls_csv(path: Path, *, devices: int = 1) -> ScriptedControls:
    """Read scripted controls of so many devices; a rollout that was written as CSV can be simulated again.

    The columns are `time_s` (end of each period, all of one length), `translation_mm_s` and `rotation_rad_s`; optional
    are `world` (several navigations in one file), and `inserted_length_mm` with `rotation_rad` (state at the end of
    each period, from which the initial one follows; else 0). Columns of catheters begin with `catheter_1_` and
    `catheter_2_`. Raises InputError for another table (`csv_file`).
    """
    prefixes = column_prefixes(devices)
    driven = [prefix + name for prefix in prefixes for name in _COLUMNS[1:]]
    state = [prefix + name for prefix in prefixes for name in ("inserted_length_mm", "rotation_rad")]
    table = read_columns(path, [_COLUMNS[0], *driven], ["world", *state])
    there = [name for name in state if name in table.values]
    if there and len(there) < len(state):
        absent = next(name for name in state if name not in there)
        raise InputError(f"{path}: column {absent} is missing where {there[0]} is there; give both, or neither")
    unused = [name for name in table.header if re.fullmatch(r"catheter_\d+_translation_mm_s", name)][devices - 1 :]
    if unused:
        warnings.warn(f"{path}: column {unused[0]} is not used: no such catheter is simulated", Remark, stacklevel=2)
    worlds = _rows_of_worlds(table)
    period_s = _period(table, worlds)
    control = np.stack([table.values[name][worlds] for name in driven], axis=-1).reshape(*worlds.shape, devices, 2)
    initial = np.zeros((len(worlds), devices, 2))
    if there:
        first = np.stack([table.values[name][worlds[:, 0]] for name in state], axis=-1)
        initial = first.reshape(initial.shape) - period_s * control[:, 0]
    return ScriptedControls(initial, control, period_s)


def _rows_of_worlds(table: Columns) -> Int[np.ndarray, "worlds samples"]:
    if "world" not in table.values:
        return np.arange(len(table.lines))[None]
    world = table.values["world"]
    table.refuse((world != np.round(world)) | (world < 0), "world", "; give a whole number of 0 or more")
    numbers, counts = np.unique(world, return_counts=True)
    if counts.min() < counts.max():
        few = int(np.argmin(counts))
        raise InputError(
            f"{table.path}: worlds differ in their number of rows: world {numbers[few]:.0f} has {counts[few]}, world "
            f"{numbers[np.argmax(counts)]:.0f} has {counts.max()}; give each as many"
        )
    return np.argsort(world, kind="stable").reshape(len(numbers), -1)


def _period(table: Columns, worlds: Int[np.ndarray, "worlds samples"]) -> float:
    """Return how long each control holds, s: the time of the first row, which all others count on."""
    time_s = table.values["time_s"]
    first, counts = int(worlds[0, 0]), np.arange(worlds.shape[1]) + 1
    period_s = float(time_s[first])
    if period_s <= 0:
        raise table.fault(first, "time_s", "; the first row ends the first period, as at 0.5")
    low, high = PERIODS_S
    if not low <= period_s <= high:
        ms = period_s / 1000
        meant = f" seems to be in ms ({period_s:g} ms is {ms:g} s)" if low <= ms <= high else ""
        raise table.fault(first, "time_s", f"{meant}; give seconds; a period has {low:g} to {high:g}")
    late = np.argwhere(np.abs(time_s[worlds] - period_s * counts) > 1e-6 * len(counts) * period_s)
    if len(late):
        rule = f"each world's rows end periods of one length and count {period_s:.10g}, {2 * period_s:.10g}, ..."
        raise table.fault(int(worlds[tuple(late[0])]), "time_s", f"; {rule}")
    return period_s
