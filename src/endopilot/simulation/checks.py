"""Checks of what the simulator is given: anatomy, controls and memory; each raises `InputError` with one line."""

from __future__ import annotations

import os
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from endopilot.devices.device import Device
from endopilot.devices.drive_limits import SPARE_MM
from endopilot.devices.stack import Stack
from endopilot.errors import InputError
from endopilot.simulation.config import FREE_BEHIND_MM, Actuation
from endopilot.types import Anatomy

_ROUNDING_MM = 1e-2
"""An inserted length may be rounded this far below 0, mm."""


def check_distance_map(anatomy: Anatomy) -> None:
    """Check insertion and distance map: the map is finite, and positive around the ostium along the catheter's axis.

    Raises:
        InputError: it is not.
    """
    field, insertion = anatomy.distance_map, anatomy.insertion
    if not np.isfinite(field.values).all():
        raise InputError(f"{anatomy.name}: the distance map has values that are not finite; extract it again")
    if not 0 < field.spacing_mm < np.inf:
        raise InputError(
            f"{anatomy.name}: the distance map's spacing_mm is {field.spacing_mm}; give a positive spacing"
        )
    if not np.isfinite(insertion.position).all():
        raise InputError(f"{anatomy.name}: insertion.position = {insertion.position} is not finite; extract it again")
    if not abs(float(np.linalg.norm(insertion.direction)) - 1) <= 1e-3:
        raise InputError(f"{anatomy.name}: insertion.direction = {insertion.direction} is no unit vector; normalise it")
    zero = insertion.rotation_zero
    if isinstance(zero, np.ndarray):
        along, size = float(zero @ insertion.direction), float(np.linalg.norm(zero))
        if not (abs(along) <= 1e-3 and abs(size - 1) <= 1e-3):
            raise InputError(
                f"{anatomy.name}: insertion.rotation_zero = {zero} is no unit vector across insertion.direction = "
                f"{insertion.direction}; turn both alike, or leave it out to have the vessel's"
            )
    for along in (-FREE_BEHIND_MM, 0.0, 1.0):
        point = insertion.position + along * insertion.direction
        index = np.round((point - field.origin_mm) / field.spacing_mm).astype(int)[::-1]
        inside = (index >= 0).all() and (index < field.values.shape).all()
        value = float(field.values[tuple(index)]) if inside else -np.inf
        if value <= 0:
            raise InputError(
                f"{anatomy.name}: the distance map is {value:.2f} mm at {along:+g} mm from the ostium along the "
                "catheter, where it must be positive (inside); check the insertion and the sign of the map"
            )


def check_memory(needed: int, what: str, mend: str) -> None:
    """Check that `needed` bytes are at most 0.8 of the machine's memory.

    Raises:
        InputError: they are more; it begins with `what` needs them and ends with the mend.
    """
    available = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    if needed > 0.8 * available:
        raise InputError(f"{what} need {needed / 2**30:.1f} GiB of {available / 2**30:.1f}; {mend}")


def check_control(
    control: Float[np.ndarray, "..."], largest: Float[np.ndarray, "worlds numbers"], stacks: Sequence[Stack]
) -> None:
    """Check the controls of one step.

    Args:
        control: a row a world.
        largest: magnitude that no control may exceed, likewise.
        stacks: wire and catheters of the worlds.

    Raises:
        InputError: an array of another shape, or a control that is not finite or too large.
    """
    if control.shape != largest.shape:
        raise InputError(f"control: shape {control.shape}; give {largest.shape}, a row a world")
    allowed = np.abs(control) <= largest
    if allowed.all():
        return
    world = int(np.argmin(allowed.all(axis=1)))
    if not np.isfinite(control[world]).all():
        raise InputError(f"control: world {world}: {control[world]} is not finite; correct it")
    which = int(np.argmin(allowed[world])) // 2
    device, asked = stacks[world].devices[which], control[world, 2 * which : 2 * which + 2]
    raise InputError(
        f"control: world {world}: {asked[0]:g} mm/s, {asked[1]:g} rad/s exceed "
        f"{device.max_velocity_mm_s:g} mm/s, {device.max_rotation_rad_s:g} rad/s, the limits of "
        f"{device.name}; slow down"
    )


def check_travel(end_mm: Float[np.ndarray, "worlds"], longest_mm: Float[np.ndarray, "worlds"]) -> None:
    """Check that no world's wire is driven beyond its end.

    Args:
        end_mm: inserted lengths at the end of a step, mm.
        longest_mm: those that the wires are laid out for, mm.

    Raises:
        InputError: one is.
    """
    if (end_mm > longest_mm).any():
        world = int(np.argmax(end_mm - longest_mm))
        raise InputError(
            f"control: world {world}: would insert {end_mm[world]:.1f} mm, and the wire is laid out for "
            f"{longest_mm[world]:.1f} mm, {SPARE_MM:g} mm more than the vessel's longest path; push less"
        )


def check_sequences(
    device: Device,
    control: Float[np.ndarray, "worlds samples 2"],
    initial: Float[np.ndarray, "worlds 2"],
    friction: Float[np.ndarray, "worlds"],
    actuation: Actuation,
    period_s: float,
) -> tuple[float, float]:
    """Check sequences of controls, and return how deep they lead.

    Args:
        device: the wire, whose velocity limits hold.
        control: mm/s and rad/s, or N and N·mm.
        initial: inserted length (mm) and rotation (rad) before the first period.
        friction: Coulomb friction coefficients.
        actuation: what the controls are.
        period_s: time that each holds, s.

    Returns:
        The largest inserted length that is commanded, mm, and the largest that can come of it: a drive that slips
        leaves in the vessel what it did not pull back, and pushes on from there.

    Raises:
        InputError: a number that is not finite or out of its range, or a control that is too fast.
    """
    if actuation not in ("velocity", "force"):
        raise InputError(f"actuation: {actuation!r}; give 'velocity' or 'force'")
    worlds, samples = control.shape[:2]
    if worlds == 0 or samples == 0:
        raise InputError(f"control: {worlds} worlds of {samples} samples; give at least one of one")
    limits = (("translation", device.max_velocity_mm_s, "mm/s"), ("rotation", device.max_rotation_rad_s, "rad/s"))
    if actuation == "force":
        limits = (("force", np.inf, "N"), ("torque", np.inf, "N·mm"))
    for axis, (name, limit, unit) in enumerate(limits):
        _check(~np.isfinite(control[..., axis]), control[..., axis], f"{name} is no finite number; correct it")
        fast = np.abs(control[..., axis]) > limit * (1 + 1e-6)
        _check(fast, control[..., axis], f"{name} in {unit} exceeds {device.name}'s limit of {limit:g}; slow down")
    _check(~np.isfinite(initial), initial, "initial state is no finite number; correct it")
    _check(initial[:, 0] < -_ROUNDING_MM, initial[:, 0], "initial inserted length in mm is negative; give 0 or more")
    _check(~(np.isfinite(friction) & (friction >= 0)), friction, "friction must be a finite number of 0 or more")
    advance = period_s * control[..., 0] if actuation == "velocity" else np.zeros(control.shape[:2])
    inserted = np.cumsum(np.column_stack([initial[:, 0], advance]), axis=1)
    return float(inserted.max()), float((initial[:, 0] + np.maximum(advance, 0.0).sum(axis=1)).max())


def _check(bad: Bool[np.ndarray, "worlds *rest"], values: Float[np.ndarray, "worlds *rest"], what: str) -> None:
    if bad.any():
        where = [int(i) for i in np.argwhere(bad)[0]]
        at = f", sample {where[1]}" if len(where) > 1 else ""
        raise InputError(f"world {where[0]}{at}: {values[tuple(where)]:g}: {what}")
