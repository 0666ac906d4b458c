"""Checks of what the simulator is given: anatomy, controls and memory; each raises `InputError` with one line."""

from __future__ import annotations

import os
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from endopilot.devices.stack import Stack
from endopilot.errors import InputError
from endopilot.simulation.config import FREE_BEHIND_MM, Actuation
from endopilot.types import Anatomy

ROUNDING_MM = 1e-2  # an inserted length may be rounded this far below 0, mm


def check_distance_map(anatomy: Anatomy) -> None:
    """Raise InputError unless the distance map is finite, and positive around the ostium along the catheter's axis."""
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
    """Raise InputError, which begins with `what` needs it, for more bytes than 0.8 of the machine's memory."""
    available = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    if needed > 0.8 * available:
        raise InputError(f"{what} need {needed / 2**30:.1f} GiB of {available / 2**30:.1f}; {mend}")


def check_shape_memory(worlds: int, samples: int, nodes: int) -> None:
    """Raise InputError unless the positions of all nodes, 24 bytes each, fit into 0.8 of the machine's memory."""
    what = f"shapes of {worlds} worlds of {samples} samples"
    check_memory(24 * worlds * samples * nodes, what, "simulate fewer at once")


def with_device_axis(name: str, array: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return an array with its axis of devices (the second of a shape of two, else the last but one), which a wire
    alone may leave out. Raises InputError, which begins with `name`, for another shape."""
    axis = 1 if len(shape) == 2 else len(shape) - 2
    without = shape[:axis] + shape[axis + 1 :]
    if shape[axis] == 1 and array.shape == without:
        return np.expand_dims(array, axis)
    if array.shape != shape:
        raise InputError(f"{name}: shape {array.shape}; give {without if shape[axis] == 1 else shape}")
    return array


def check_control(
    control: Float[np.ndarray, "worlds samples devices 2"],
    largest: Float[np.ndarray, "worlds devices 2"],
    stacks: Sequence[Stack],
    actuation: Actuation,
) -> None:
    """Raise InputError unless controls are finite (mm/s and rad/s, or N and N·mm) and within their drives' limits."""
    if (np.abs(control) <= largest[:, None]).all():
        return
    names = ("force in N", "torque in N·mm") if actuation == "force" else ("translation in mm/s", "rotation in rad/s")
    finite = np.isfinite(control)
    bad = ~finite if not finite.all() else np.abs(control) > largest[:, None]
    world, sample, which, axis = (int(place) for place in np.argwhere(bad)[0])
    at = f", sample {sample}" if control.shape[1] > 1 else ""
    where = f"control: world {world}{at}: {control[world, sample, which, axis]:g}: {names[axis]}"
    if not finite.all():
        raise InputError(f"{where} is no finite number; correct it")
    device = stacks[world].devices[which]
    limit = (device.max_velocity_mm_s, device.max_rotation_rad_s)[axis]
    raise InputError(f"{where} exceeds {device.name}'s limit of {limit:g}; slow down")


def check_travel(deepest_mm: Float[np.ndarray, "worlds devices"], longest_mm: Float[np.ndarray, "worlds"]) -> None:
    """Raise InputError where a device may be driven deeper than it is laid out for, mm."""
    deepest_mm = deepest_mm.max(axis=1)
    if (deepest_mm > longest_mm).any():
        world = int(np.argmax(deepest_mm - longest_mm))
        raise InputError(
            f"control: world {world}: may insert {deepest_mm[world]:.1f} mm, and the devices are laid out for "
            f"{longest_mm[world]:.1f} mm; push less, or give a larger reach_mm"
        )
