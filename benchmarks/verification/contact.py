"""Verification of wall contact and friction: a string pulled around a bend."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from benchmarks.verification.scenes import tortuous_axis, tube
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.core import make_lumen
from endopilot.types import DistanceMap, Insertion
from endopilot.verification.free_rod import Case, Curve, Loading, Picture, compare, equilibrium, straight_rod

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


@dataclass(frozen=True, eq=False)
class Pulled:
    """A string pulled back through a tube against a dead load on its tip.

    Attributes:
        shape_mm: nodes at the end, from tip to base, mm.
        time_s: time of the samples of the pull, and of the last of the push before it, s.
        ratio: pull at the drive over the load on the tip, at those times.
    """

    shape_mm: Float[np.ndarray, "n 3"]
    time_s: Float[np.ndarray, "samples"]
    ratio: Float[np.ndarray, "samples"]


def pull_string(
    field: DistanceMap, *, length_mm: float, out: Float[np.ndarray, "3"], friction: float, insertion: Insertion
) -> Pulled:
    """Push a string into a tube until `length_mm` of it are inside, and pull it back.

    Args:
        field: the tube.
        length_mm: inserted length at the turn, mm.
        out: direction of the dead load on the tip, no more than 90° from that of any part of the tube: the string is
            always taut.
        friction: Coulomb coefficient µ.
        insertion: where the string enters.
    """
    load, size = 0.1, 0.75
    rod = straight_rod(
        elements=int(length_mm / size),
        length_mm=length_mm,
        bend=0.1,
        twist=0.1,
        shear=50.0,
        stretch=100.0,
        radius_mm=WIRE_RADIUS_MM,
        drag=1e-6,
    )
    loading = Loading.none(len(rod.abscissa_mm))
    loading.force_n[0] = load * out
    push_samples, pull_samples = int((length_mm - 4.0) / 5.0), 10
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
        insertion=insertion,
        inserted_length_mm=2.0,
        free_behind_mm=0.5 * size,
    )
    time = 0.5 * np.arange(len(control))
    pulled = time > 0.5 * (push_samples - 6)
    return Pulled(result["shape"][-1], time[pulled], -result["base_force"][pulled] / load)


def _capstan_case(name: str, pulled: Pulled, friction: float, angle: float) -> Case:
    """Compare the pull with exp(µ θ)."""
    reference, ends = float(np.exp(friction * angle)), pulled.time_s[[0, -1]]
    curves = (
        Curve("exp(µθ)", ends, np.full(2, reference), "reference"),
        Curve("exp(−µθ)", ends, np.full(2, 1 / reference), "reference"),
        Curve("core, pushed in, then pulled", pulled.time_s, pulled.ratio),
    )
    return compare(
        name, reference, pulled.ratio[-1], 0.02, Picture("time, s", "pull at the base / load on the tip", curves)
    )


def capstan() -> list[Case]:
    """Pull a string around a bend of 90° against a dead load: T2/T1 = exp(µ θ) (Euler's capstan equation).

    The angle is that between the string's free spans, which the clearance makes a little less than that of the bend.
    """
    angle, friction = np.pi / 2, 0.4
    field = bent_tube(angle, radius_mm=TUBE_RADIUS_MM, bend_radius_mm=BEND_RADIUS_MM, lead_mm=LEAD_MM)
    out = np.array([np.cos(angle), np.sin(angle), 0.0])
    start = Insertion(position=np.array([-LEAD_MM, 0.0, 0.0]), direction=np.array([1.0, 0.0, 0.0]))
    length = 1.7 * LEAD_MM + BEND_RADIUS_MM * angle
    pulled = pull_string(field, length_mm=length, out=out, friction=friction, insertion=start)
    entry = pulled.shape_mm[np.argmin(np.abs(pulled.shape_mm[:, 0] + 0.4 * LEAD_MM))] - start.position
    wrapped = np.arccos(np.dot(entry, out) / np.linalg.norm(entry))
    return [_capstan_case("capstan T2/T1", pulled, friction, float(wrapped))]


def _cut_at_entry(lead_mm: float, bend_radius_mm: float) -> float:
    """Return the angle that a taut string, held on the tube's axis ahead of a bend, turns less than the bend, rad.

    It meets the inner wall's arc, of radius R - c about the bend's centre, on a tangent.
    """
    to_centre = np.hypot(lead_mm, bend_radius_mm)
    inner = bend_radius_mm - (TUBE_RADIUS_MM - WIRE_RADIUS_MM)
    return float(np.arctan2(bend_radius_mm, lead_mm) - np.arcsin(inner / to_centre))


def capstan_over_bends() -> list[Case]:
    """Pull a string through three bends of 60°, left, right and left: T2/T1 = exp(µ Σθ), whatever their directions.

    A taut string goes from the inner wall of one bend to that of the next, on a common tangent of two arcs of radius
    R - c, whose centres are 2 R apart: each turns less than the bend by arccos((R - c)/R) there. c is the clearance.
    """
    bend, bends, friction, lead = np.pi / 3, 3, 0.3, 15.0
    turns = bend * np.array([1.0, -1.0, 1.0])
    axis = tortuous_axis(turns, bend_radius_mm=BEND_RADIUS_MM, lead_mm=lead, tail_mm=25.0)
    out = np.array([np.cos(turns.sum()), np.sin(turns.sum()), 0.0])
    start = Insertion(position=axis[0], direction=np.array([1.0, 0.0, 0.0]))
    length = lead + BEND_RADIUS_MM * bend * bends + 15.0
    field = tube(axis, TUBE_RADIUS_MM)
    pulled = pull_string(field, length_mm=length, out=out, friction=friction, insertion=start)
    clearance = TUBE_RADIUS_MM - WIRE_RADIUS_MM
    crossing = np.arccos((BEND_RADIUS_MM - clearance) / BEND_RADIUS_MM)
    angle = bends * bend - _cut_at_entry(lead, BEND_RADIUS_MM) - 2 * (bends - 1) * crossing
    return [_capstan_case("capstan over three bends T2/T1", pulled, friction, float(angle))]


def capstan_in_a_helix() -> list[Case]:
    """Pull a string through a helical tube: T2/T1 = exp(µ θ), with θ = ∫κ ds of the string in space.

    Taut, it lies on the tube's inner side: on a helix of radius a - c and of the tube's own pitch 2π p, which turns by
    2π (a - c)/√((a - c)² + p²) a revolution. At the entry it turns less, as in a bend of the helix' own radius of
    curvature.
    """
    radius, pitch, revolutions, friction, lead = 12.0, 12.0, 1.0, 0.2, 15.0
    around = np.linspace(0, 2 * np.pi * revolutions, 4000)
    coil = np.column_stack([radius * np.sin(around), radius * (1 - np.cos(around)), pitch * around])
    ends = [
        np.array([radius * np.cos(v), radius * np.sin(v), pitch]) / np.hypot(radius, pitch) for v in around[[0, -1]]
    ]
    line = np.linspace(0, 1, 1000)[:, None]
    axis = np.concatenate([(line - 1)[:-1] * lead * ends[0], coil, coil[-1] + line[1:] * 25.0 * ends[1]])
    start = Insertion(position=axis[0], direction=ends[0])
    length = lead + float(np.hypot(radius, pitch)) * around[-1] + 15.0
    field, out = tube(axis, TUBE_RADIUS_MM, spacing_mm=0.25), ends[1]
    pulled = pull_string(field, length_mm=length, out=out, friction=friction, insertion=start)
    inner = radius - (TUBE_RADIUS_MM - WIRE_RADIUS_MM)
    angle = around[-1] * inner / np.hypot(inner, pitch) - _cut_at_entry(lead, (radius**2 + pitch**2) / radius)
    return [_capstan_case("capstan in a helix T2/T1", pulled, friction, float(angle))]


CASES = (capstan, capstan_over_bends, capstan_in_a_helix)
