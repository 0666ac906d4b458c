"""Proximal controls: random navigations, and scripted ones from a CSV file.

A control π is the mean velocity (dΔ/dt mm/s, dφ/dt rad/s) over one sample period of 0.5 s.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from jaxtyping import Float
from pydantic import model_validator

from endopilot.errors import InputError
from endopilot.files import writing
from endopilot.settings import NonNegative, Share, Within, settings
from endopilot.simulation.drive_limits import within_travel
from endopilot.types import SAMPLE_PERIOD_S

_COLUMNS = ("time_s", "translation_mm_s", "rotation_rad_s")
_KINDS = ("insertion", "retraction", "spin", "pause")
_DRIVE = 2**32
"""From the key of a navigation's wire to that of its catheter; no study has that many navigations."""


@settings
class ControlConfig:
    """Random navigations: manoeuvres of random kind, length and speed, joined smoothly."""

    max_velocity_mm_s: NonNegative = 12.0
    """Fastest translation, mm/s."""
    max_rotation_rad_s: NonNegative = 3.0
    """Fastest rotation, rad/s."""
    insertion_share: Share = 0.45
    """Share of the manoeuvres that push."""
    retraction_share: Share = 0.3
    """Share of the manoeuvres that pull."""
    spin_share: Share = 0.15
    """Share of the manoeuvres that only rotate; what is left over are pauses."""
    rotation_share: Share = 0.6
    """Share of the pushing and pulling manoeuvres that rotate too."""
    shortest_s: Annotated[float, Within(SAMPLE_PERIOD_S)] = 1.0
    """Shortest manoeuvre, s."""
    longest_s: Annotated[float, Within(SAMPLE_PERIOD_S)] = 6.0
    """Longest manoeuvre, s."""
    first_inserted_length_mm: NonNegative = 5.0
    """Least inserted length that a navigation starts with, mm."""
    start_spread: Share = 0.6
    """Starts are spread from there over this share of the largest inserted length."""

    @model_validator(mode="after")
    def _consistent(self) -> ControlConfig:
        total = self.insertion_share + self.retraction_share + self.spin_share
        if total > 1 + 1e-9:
            raise ValueError(f"insertion_share + retraction_share + spin_share: {total:g}; keep their sum at 1 or less")
        if self.shortest_s > self.longest_s:
            raise ValueError(f"shortest_s, longest_s: {self.shortest_s}, {self.longest_s}; give the shorter time first")
        return self


def random_controls(
    config: ControlConfig,
    *,
    n_sequences: int,
    n_samples: int,
    seed: int,
    max_inserted_length_mm: float,
    first: int = 0,
    catheters: int = 0,
) -> tuple[Float[np.ndarray, "n numbers"], Float[np.ndarray, "n samples numbers"]]:
    """Draw random navigations; sequence i is the same whatever `n_sequences`.

    Args:
        config: their distribution.
        n_sequences: number of navigations.
        n_samples: number of sample periods of each.
        seed: key of the random streams.
        max_inserted_length_mm: largest inserted length that a navigation reaches, mm; the smallest is 0.
        first: index of the first of them.
        catheters: number of catheters around the wire; each is driven independently of it, with the same distribution.

    Returns:
        Initial (Δ mm, φ rad), and controls (mm/s, rad/s), of the wire, then of each catheter.

    Raises:
        InputError: a number that is not positive, or a negative seed.
    """
    if n_sequences < 1 or n_samples < 1:
        raise InputError(f"random controls: {n_sequences} sequences of {n_samples} samples; give at least 1 of 1")
    if not 0 <= seed < 2**64:
        raise InputError(f"seed: {seed}; give a whole number from 0 to 2^64 - 1")
    if not 0 < max_inserted_length_mm < np.inf:
        raise InputError(f"max_inserted_length_mm: {max_inserted_length_mm}; give a positive length")
    initial, control = np.empty((n_sequences, 1 + catheters, 2)), np.empty((n_sequences, n_samples, 1 + catheters, 2))
    for index, drive in np.ndindex(n_sequences, 1 + catheters):
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
    return initial.reshape(n_sequences, -1), control.reshape(n_sequences, n_samples, -1)


def free_wire_load(
    velocity: Float[np.ndarray, "*n 2"], *, radius_mm: float, friction_n: float, drag_n_s_mm: float, stick_mm_s: float
) -> Float[np.ndarray, "*n 2"]:
    """Return the drive's force (N) and torque (N·mm) that move a wire through the introducer alone at some velocity.

    The wire's surface moves by v = (Δ̇, r φ̇) past the valve, whose smoothed Coulomb friction F and drag c oppose it with
    F v / √(v² + ε²) + c v, as the rod core has it.

    Args:
        velocity: Δ̇ (mm/s) and φ̇ (rad/s).
        radius_mm: of the wire, r.
        friction_n: F.
        drag_n_s_mm: c.
        stick_mm_s: ε, velocity below which friction falls off.
    """
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
        samples = max(1, round(generator.uniform(config.shortest_s, config.longest_s) / SAMPLE_PERIOD_S))
        wanted[at : at + samples] = _manoeuvre(config, generator)
        at += samples
    smooth = 0.25 * wanted[:-2] + 0.5 * wanted[1:-1] + 0.25 * wanted[2:]  # ramps of one period between manoeuvres
    return initial, smooth


def _manoeuvre(config: ControlConfig, generator: np.random.Generator) -> Float[np.ndarray, "2"]:
    """Return the mean velocities of one manoeuvre; always draws the same number of random numbers."""
    shares = np.array([config.insertion_share, config.retraction_share, config.spin_share])
    kind = _KINDS[int(np.searchsorted(np.cumsum(shares), generator.random(), side="right"))]
    speed, turns, spin = generator.random(), generator.random() < config.rotation_share, generator.uniform(-1, 1)
    translation = {"insertion": 1.0, "retraction": -1.0}.get(kind, 0.0) * (0.15 + 0.85 * speed)
    rotation = spin if kind == "spin" or (turns and kind != "pause") else 0.0
    return np.array([translation * config.max_velocity_mm_s, rotation * config.max_rotation_rad_s])


@dataclass(frozen=True, eq=False)
class ScriptedControls:
    """Controls from a file.

    Attributes:
        initial: (Δ mm, φ rad) of each world before the first period, of the wire and of each catheter.
        control: mm/s and rad/s, likewise.
        period_s: time that each control holds, s.
    """

    initial: Float[np.ndarray, "worlds numbers"]
    control: Float[np.ndarray, "worlds samples numbers"]
    period_s: float


def read_controls_csv(path: Path, *, catheters: int = 0) -> ScriptedControls:
    """Read scripted controls.

    The columns are `time_s` (end of each period, all of one length: 0.5, 1.0, ... or 0.05, 0.1, ...),
    `translation_mm_s` and `rotation_rad_s`; optional are `world` (several navigations in one file), and
    `inserted_length_mm` with `rotation_rad` (state at the end of each period, from which the initial one follows; 0 if
    they are not there). So a rollout that was written as CSV can be simulated again. Columns of catheters begin with
    `catheter_1_` and `catheter_2_`.

    Args:
        path: the file.
        catheters: how many catheters it drives; each adds two numbers to the controls and the initial state.

    Raises:
        InputError: not such a table; the line names file, column, row and mend.
    """
    import pandas as pd  # slow to import, and needed for files alone

    try:
        table = pd.read_csv(path, float_precision="round_trip")
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read as CSV ({str(error).splitlines()[0]}); check the file") from error
    prefixes = ["", *(f"catheter_{k + 1}_" for k in range(catheters))]
    driven = [prefix + name for prefix in prefixes for name in _COLUMNS[1:]]
    wanted = [_COLUMNS[0], *driven]
    missing = [name for name in wanted if name not in table.columns]
    if missing:
        raise InputError(f"{path}: column {missing[0]} is missing; the columns are {', '.join(wanted)}")
    if len(table) == 0:
        raise InputError(f"{path}: has no rows; give one for each {SAMPLE_PERIOD_S} s")
    places = [prefix + name for prefix in prefixes for name in ("inserted_length_mm", "rotation_rad")]
    state = [name for name in places if name in table.columns]
    for name in (*wanted, *state):
        numbers = np.asarray(pd.to_numeric(table[name], errors="coerce"), dtype=float)
        bad = np.flatnonzero(~np.isfinite(numbers))
        if len(bad):
            row = int(bad[0])
            raise InputError(f"{path}: row {row + 2}: {name} = {table[name].iloc[row]} is no finite number; correct it")
        table[name] = numbers
    worlds = [rows for _, rows in table.groupby("world", sort=True)] if "world" in table.columns else [table]
    samples, period_s = len(worlds[0]), float(worlds[0]["time_s"].iloc[0])
    if period_s <= 0:
        raise InputError(f"{path}: row 2: time_s = {period_s:g}; the first row ends the first period, as at 0.5")
    for rows in worlds:
        if len(rows) != samples:
            raise InputError(f"{path}: worlds differ in their number of rows; give each {samples}")
        late = np.flatnonzero(np.abs(rows["time_s"] - period_s * (np.arange(samples) + 1)) > 1e-6 * samples * period_s)
        if len(late):
            row = int(rows.index[late[0]])
            raise InputError(
                f"{path}: row {row + 2}: time_s = {table['time_s'].iloc[row]:g}; each world's rows end periods of one "
                f"length and count {period_s:g}, {2 * period_s:g}, ..."
            )
    control = np.stack([rows[driven].to_numpy(dtype=float) for rows in worlds])
    initial = np.zeros((len(worlds), len(driven)))
    if len(state) == len(driven):
        ends = np.stack([rows[state].to_numpy(dtype=float)[0] for rows in worlds])
        initial = ends - period_s * control[:, 0]
    return ScriptedControls(initial, control, period_s)


def write_controls_csv(
    path: Path,
    control: Float[np.ndarray, "samples numbers"],
    proximal: Float[np.ndarray, "samples numbers"],
    period_s: float,
) -> None:
    """Write controls so that `read_controls_csv` reads them.

    Args:
        path: where to.
        control: mm/s and rad/s of the wire, then of each catheter.
        proximal: (Δ mm, φ rad) at the end of each, likewise.
        period_s: time that each holds, s.
    """
    import pandas as pd

    time_s = period_s * np.arange(1, len(control) + 1)
    prefixes = ["", *(f"catheter_{k + 1}_" for k in range(control.shape[1] // 2 - 1))]
    names = [_COLUMNS[0], *(prefix + name for prefix in prefixes for name in _COLUMNS[1:])]
    names += [prefix + name for prefix in prefixes for name in ("inserted_length_mm", "rotation_rad")]
    with writing(path) as partial:
        pd.DataFrame(np.column_stack([time_s, control, proximal]), columns=names).to_csv(partial, index=False)
