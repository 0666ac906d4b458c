"""Verification of wall contact and friction: a string pulled around a bend."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.core import make_lumen
from endopilot.types import DistanceMap, Insertion
from endopilot.verification.case import Case, Curve, Loading, Picture, compare, equilibrium, straight_rod

LEAD_MM = 30.0
BEND_RADIUS_MM = 15.0
TUBE_RADIUS_MM = 0.6
WIRE_RADIUS_MM = 0.2


def bent_tube(
    angle_rad: float, *, radius_mm: float, bend_radius_mm: float, lead_mm: float, spacing_mm: float = 0.2
) -> DistanceMap:
    """Return the distance map of a tube that comes along x, bends by an angle towards y and goes on straight.

    Args:
        angle_rad: angle of the bend, up to π.
        radius_mm: inner radius of the tube, mm.
        bend_radius_mm: radius of the bend's centerline, mm.
        lead_mm: straight length before and after the bend, mm; the tube begins at x = -lead and has open ends.
        spacing_mm: grid spacing, mm.
    """
    s = np.linspace(0, 1, 200)
    arc = bend_radius_mm * np.column_stack([np.sin(angle_rad * s), 1 - np.cos(angle_rad * s), 0 * s])
    out = np.array([np.cos(angle_rad), np.sin(angle_rad), 0.0])
    line = np.concatenate([[[-lead_mm, 0, 0]], arc, [arc[-1] + lead_mm * out]])
    margin = radius_mm + 4 * spacing_mm
    origin = line.min(axis=0) - margin
    shape = np.ceil((line.max(axis=0) + margin - origin) / spacing_mm).astype(int) + 1
    x, y, z = (origin[i] + spacing_mm * np.arange(shape[i]) for i in range(3))
    plane = np.stack(np.meshgrid(x, y, indexing="xy"), axis=-1)  # (ny, nx, 2)
    before = np.where(plane[..., 0] <= 0, np.abs(plane[..., 1]), np.inf)
    centre = np.array([0.0, bend_radius_mm])
    polar = plane - centre
    turned = np.mod(np.arctan2(polar[..., 0], -polar[..., 1]), 2 * np.pi)
    around = np.where(turned <= angle_rad, np.abs(np.hypot(polar[..., 0], polar[..., 1]) - bend_radius_mm), np.inf)
    rest = plane - arc[-1, :2]
    along = rest @ out[:2]
    after = np.where(along >= 0, np.abs(rest @ np.array([-out[1], out[0]])), np.inf)
    to_line: Float[np.ndarray, "ny nx"] = np.minimum(np.minimum(before, around), after)
    values = radius_mm - np.sqrt(to_line[None] ** 2 + z[:, None, None] ** 2)
    return DistanceMap(values=np.maximum(values, -1.0), spacing_mm=spacing_mm, origin_mm=origin)


def capstan() -> list[Case]:
    """Pull a string around a bend of 90° against a dead load: T2/T1 = exp(µ θ) (Euler's capstan equation).

    The angle is that between the string's free spans, which the clearance makes a little less than that of the bend.
    """
    angle, load, friction, size = np.pi / 2, 0.1, 0.4, 0.75
    field = bent_tube(angle, radius_mm=TUBE_RADIUS_MM, bend_radius_mm=BEND_RADIUS_MM, lead_mm=LEAD_MM)
    length = 1.7 * LEAD_MM + BEND_RADIUS_MM * angle
    rod = straight_rod(
        elements=int(length / size),
        length_mm=length,
        bend=0.1,
        twist=0.1,
        shear=50.0,
        stretch=100.0,
        radius_mm=WIRE_RADIUS_MM,
        drag=1e-6,
    )
    loading = Loading.none(len(rod.abscissa_mm))
    pull = np.array([np.cos(angle), np.sin(angle), 0.0])
    loading.force_n[0] = load * pull
    push_samples, pull_samples = int((length - 4.0) / 5.0), 10
    control = np.zeros((push_samples + pull_samples, 2))
    control[:push_samples, 0] = 10.0
    control[push_samples:, 0] = -0.5
    result = equilibrium(
        rod,
        loading,
        control=control,
        lumen=make_lumen(field, WIRE_RADIUS_MM),
        friction=friction,
        config=SimulatorConfig(
            time_step_s=0.02, tolerance_mm=1e-5, stick_velocity_mm_s=0.02, wall_stiffness_n_mm=5.0, threads=1
        ),
        insertion=Insertion(position=np.array([-LEAD_MM, 0.0, 0.0]), direction=np.array([1.0, 0.0, 0.0])),
        inserted_mm=2.0,
        free_behind_mm=0.5 * size,
    )
    shape = result["shape"][-1]
    entry = shape[np.argmin(np.abs(shape[:, 0] + 0.4 * LEAD_MM))]
    entry = entry - [-LEAD_MM, 0.0, 0.0]
    wrapped = np.arccos(np.dot(entry, pull) / np.linalg.norm(entry))
    tension = -result["base_force"]
    time = 0.5 * np.arange(len(tension))
    reference = float(np.exp(friction * wrapped))
    pulled = time > 0.5 * (push_samples - 6)
    picture = Picture(
        "time, s",
        "pull at the base, N",
        (
            Curve("T1 exp(µθ)", time[pulled][[0, -1]], np.full(2, load * reference), "reference"),
            Curve("T1 exp(−µθ)", time[pulled][[0, -1]], np.full(2, load / reference), "reference"),
            Curve("core, pushed in, then pulled", time[pulled], tension[pulled]),
        ),
    )
    return [compare("capstan T2/T1", reference, tension[-1] / load, 0.02, picture)]


CASES = (capstan,)
