"""Scenes in analytic vessels, each of which shows one thing that guidewires do: drag, stick-slip, torque lag, buckling.

docs/evidence/physics.md shows them in pictures, and the tests hold each against its physics.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.integrate import solve_ivp
from scipy.spatial import KDTree

from endopilot.devices.device import read_wire
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.core import make_lumen
from endopilot.simulation.rod import RodLayout, lay_out
from endopilot.types import SAMPLE_PERIOD_S, DistanceMap, Insertion
from endopilot.verification.free_rod import Loading, driven, uniform_rod

_FINE_MM = 0.02
"""Spacing of the points that a vessel's axis is sampled at, mm: the distance to them errs by less than 1e-4 mm."""
_OUTSIDE_MM = -1.0
"""Distances are cut off here, mm."""

DRAG_LOAD_N = 0.1
"""Dead load on the tip that is dragged through the tortuous vessel, N."""
DRAG_BEND_RAD = np.pi / 3
"""Angle of each of the tortuous vessel's bends, rad."""
PLATE_GAP_MM = 10.0
"""Distance from where the wire is held to the plate that its tip is pushed against, mm."""
RIDGE_PITCH_MM = 6.0
"""Distance between the ridges that the tip slips over, mm."""
CURVE_RADIUS_MM = 20.0
"""Radius of the bent vessel's axis and of the curved wire that is turned in it, mm."""
WHIP_BEND_N_MM2, WHIP_TWIST_N_MM2 = 8.0, 6.2
"""EI and GJ of the curved wire, N·mm²; those of the shipped J wire's tip."""
_WHIP_LEAD_MM = 3.0
"""Straight length between the drive and the curved part, mm."""


def tortuous_axis(
    turns_rad: Float[np.ndarray, "bends"], *, bend_radius_mm: float, lead_mm: float, tail_mm: float
) -> Float[np.ndarray, "n 3"]:
    """Return the axis of a planar vessel: straight along x up to the origin, bends one after another, and straight on.

    Args:
        turns_rad: angle of each bend, positive towards +y, rad.
        bend_radius_mm: radius of every bend, mm.
        lead_mm: straight length ahead of the first bend, mm.
        tail_mm: straight length behind the last one, mm.
    """
    steps = [np.zeros(round(lead_mm / _FINE_MM))]
    for turn in turns_rad:
        count = max(1, round(bend_radius_mm * abs(turn) / _FINE_MM))
        steps.append(np.full(count, turn / count))
    steps.append(np.zeros(round(tail_mm / _FINE_MM)))
    turned = np.cumsum(np.concatenate(steps))
    middle = turned - 0.5 * np.concatenate(steps)
    points = np.cumsum(_FINE_MM * np.column_stack([np.cos(middle), np.sin(middle), np.zeros(len(middle))]), axis=0)
    return np.concatenate([np.zeros((1, 3)), points]) - [lead_mm, 0.0, 0.0]


def tube(
    axis_mm: Float[np.ndarray, "n 3"],
    radius_mm: float | Float[np.ndarray, "n"],
    *,
    spacing_mm: float = 0.2,
) -> DistanceMap:
    """Return the distance map of a tube around an axis, with round ends.

    Args:
        axis_mm: points on the axis, close to each other, mm.
        radius_mm: inner radius of the tube, at each point if several are given, mm. Where it varies, the map holds the
            radius at the nearest point less the distance to it, a distance to first order in the radius' slope.
        spacing_mm: grid spacing, mm.
    """
    radius = np.broadcast_to(np.asarray(radius_mm, dtype=float), len(axis_mm))
    margin = radius.max() - _OUTSIDE_MM + 2 * spacing_mm
    origin = axis_mm.min(axis=0) - margin
    shape = np.ceil((axis_mm.max(axis=0) + margin - origin) / spacing_mm).astype(int) + 1
    x, y, z = (origin[i] + spacing_mm * np.arange(shape[i]) for i in range(3))
    grid = np.stack(np.meshgrid(z, y, x, indexing="ij")[::-1], axis=-1)
    away, nearest = KDTree(axis_mm).query(grid, distance_upper_bound=radius.max() - _OUTSIDE_MM)
    inside = np.append(radius, 0.0)[nearest] - away  # where no point is near, `away` is infinite
    return DistanceMap(values=np.maximum(inside, _OUTSIDE_MM), spacing_mm=spacing_mm, origin_mm=origin)


@dataclass(frozen=True, eq=False)
class Dragged:
    """A wire pulled back through a tortuous vessel against a dead load on its tip.

    Attributes:
        axis_mm: axis of the vessel, mm.
        shape_mm: nodes of the wire at the end, mm.
        axis_turning_rad: sum of the angles by which the vessel's axis bends, rad.
        wire_turning_rad: the same of the wire, which cuts corners and zigzags, rad.
        ratio: pull at the drive over the load on the tip.
    """

    axis_mm: Float[np.ndarray, "m 3"]
    shape_mm: Float[np.ndarray, "n 3"]
    axis_turning_rad: float
    wire_turning_rad: float
    ratio: float


def drag_through_bends(bends: int, *, friction: float = 0.2, bend_n_mm2: float = 0.1) -> Dragged:
    """Pull a wire back through a vessel of alternating bends, against 0.1 N on its tip.

    A string obeys Euler's capstan equation T2/T1 = exp(µ θ), with θ the sum of the angles by which it turns,
    whatever their direction; a stiff wire presses on the wall even without tension, and is dragged more.

    Args:
        bends: number of bends of 60° each, left and right alternately.
        friction: Coulomb coefficient µ.
        bend_n_mm2: EI of the wire, N·mm²; 0.1 makes a string of it at this load and this radius.
    """
    size, lead, bend_radius = 0.75, 15.0, 12.0
    turns = DRAG_BEND_RAD * np.where(np.arange(bends) % 2 == 0, 1.0, -1.0)
    axis = tortuous_axis(turns, bend_radius_mm=bend_radius, lead_mm=lead + 5, tail_mm=25.0)
    length = lead + bend_radius * DRAG_BEND_RAD * bends + 15.0
    nodes = int(length / size) + 3
    rod = _uniform(nodes, size, bend_n_mm2, bend_n_mm2, shear=50.0, stretch=100.0)
    loading = Loading.none(nodes)
    loading.force_n[0] = DRAG_LOAD_N * np.array([np.cos(turns.sum()), np.sin(turns.sum()), 0.0])
    push, pull = int((length - 4.0) / 5.0), 10
    control = np.zeros((push + pull, 2))
    control[:push, 0], control[push:, 0] = 10.0, -0.5
    result = _drive(
        rod,
        tube(axis, 0.6),
        control,
        entry_mm=-lead,
        inserted_length_mm=2.0,
        friction=friction,
        config=SimulatorConfig(tolerance_mm=1e-5, stick_velocity_mm_s=0.02, wall_stiffness_n_mm=5.0, threads=1),
        free_behind_mm=size,
        loading=loading,
    )
    shape = result["shape"][-1]
    along = -np.diff(shape, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    angle = np.arccos(np.clip(np.sum(along[1:] * along[:-1], axis=1), -1, 1))[shape[1:-1, 0] > -lead]
    ratio = -float(result["base_force"][-1]) / DRAG_LOAD_N
    return Dragged(axis, shape, float(np.abs(turns).sum()), float(angle.sum()), ratio)


@dataclass(frozen=True, eq=False)
class Pushed:
    """A wire pushed against an obstacle or over some.

    Attributes:
        pushed_mm: advance of the drive, mm.
        tip_mm: advance of the tip along the vessel's end, mm.
        force_n: force of the drive, N.
        shapes_mm: nodes of the wire at each sample, from tip to base, mm.
    """

    pushed_mm: Float[np.ndarray, "samples"]
    tip_mm: Float[np.ndarray, "samples"]
    force_n: Float[np.ndarray, "samples"]
    shapes_mm: Float[np.ndarray, "samples nodes 3"]


def ridged_vessel() -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n"]]:
    """Return axis (mm) and radius (mm) of a vessel that bends by 90° and has ridges behind the bend."""
    lead, bend = 15.0, np.pi / 2 * CURVE_RADIUS_MM
    axis = tortuous_axis(np.array([np.pi / 2]), bend_radius_mm=CURVE_RADIUS_MM, lead_mm=lead, tail_mm=60.0)
    beyond = _FINE_MM * np.arange(len(axis)) - lead - bend - 2.0
    wave = 0.5 + 0.5 * np.cos(2 * np.pi * beyond / RIDGE_PITCH_MM)
    return axis, np.where(beyond > 0, 1.2 - 0.3 * wave, 1.2)


def stick_slip() -> Pushed:
    """Push the workhorse wire, with its bent tip, slowly over a vessel's ridges.

    The tip catches at a ridge; the wire behind it snakes and stores energy, until the tip slips over and ahead.
    """
    device = read_wire("workhorse-014")
    axis, radius = ridged_vessel()
    speed, samples, start = 0.5, 120, 35.0
    path = np.pi / 2 * CURVE_RADIUS_MM + 60.0
    result = _drive(
        lay_out(device, element_mm=0.4, length_mm=path + 10),
        tube(axis, radius, spacing_mm=0.15),
        np.tile([speed, 0.0], (samples, 1)),
        entry_mm=-5.0,
        inserted_length_mm=start,
        friction=0.1,
        config=SimulatorConfig(threads=1, wall_stiffness_n_mm=5.0),
        approach=True,
    )
    tip = result["tip_position"]
    return Pushed(_advance(speed, samples), tip[:, 1] - tip[0, 1], result["base_force"], result["shape"])


def push_against_a_plate(*, friction: float, tip_bend_deg: float) -> Pushed:
    """Push the workhorse wire, held 10 mm behind its tip, against a plate that stands across its path.

    A tip that slides buckles as a clamped-free column, at π² EI/(4 L²), its tip load; a tip that friction holds in its
    place as a clamped-pinned one, at 20.19 EI/L², eight times as much (S. P. Timoshenko and J. M. Gere, Theory of
    Elastic Stability, 1961, §2.1-2.2), until it slips. A bent tip bends on from the first touch.

    Args:
        friction: Coulomb coefficient of the plate.
        tip_bend_deg: angle by which the last 3 mm are bent, degrees; no wire is perfectly straight.
    """
    device = replace(read_wire("workhorse-014"), tip_bend_rad=float(np.deg2rad(tip_bend_deg)), tip_bend_length_mm=3.0)
    start, speed, samples = PLATE_GAP_MM - 0.3, 0.1, 60
    result = _drive(
        lay_out(device, element_mm=0.15, length_mm=20.0),
        _chamber(PLATE_GAP_MM + device.tip_radius_mm, 6.0),
        np.tile([speed, 0.0], (samples, 1)),
        entry_mm=0.0,
        inserted_length_mm=start,
        friction=friction,
        config=SimulatorConfig(threads=1, wall_stiffness_n_mm=5.0),
        free_behind_mm=0.0,
    )
    pushed = start - PLATE_GAP_MM + _advance(speed, samples)
    return Pushed(pushed, result["tip_position"][:, 0] - PLATE_GAP_MM, result["base_force"], result["shape"])


@dataclass(frozen=True, eq=False)
class Turned:
    """A curved wire turned in a bent vessel.

    Attributes:
        drive_rad: turn of the drive, rad.
        tip_rad: turn of the tip from where the wire's curve lies along the vessel's, rad.
        torque_n_mm: torque of the drive, N·mm.
    """

    drive_rad: Float[np.ndarray, "samples"]
    tip_rad: Float[np.ndarray, "samples"]
    torque_n_mm: Float[np.ndarray, "samples"]


def turn_in_a_bend(curved_mm: float, *, turns: float = 2.25) -> Turned:
    """Turn a wire whose distal part is curved in a vessel that is curved alike.

    The wire wants to lie with its curve along the vessel's. Turned from behind, its tip lags, and where the curved part
    is long enough, L √(EI κ₀ κ_t / GJ) > π/2, it snaps over: it whips. See `whip_theory`.

    Args:
        curved_mm: length of the curved part, mm.
        turns: turns of the drive.
    """
    size, radius, speed = 0.75, 0.2, 0.25
    axis = tortuous_axis(np.array([np.pi]), bend_radius_mm=CURVE_RADIUS_MM, lead_mm=_WHIP_LEAD_MM + 5, tail_mm=10.0)
    length = curved_mm + _WHIP_LEAD_MM
    rod = _uniform(int(length / size) + 6, size, WHIP_BEND_N_MM2, WHIP_TWIST_N_MM2, shear=220.0, stretch=220.0)
    rod.rest_curvature[rod.abscissa_mm <= curved_mm, 0] = -1 / CURVE_RADIUS_MM  # towards the vessel's own curve
    push, turning = int(np.ceil(length / 2.5)), round(turns * 2 * np.pi / speed / SAMPLE_PERIOD_S)
    control = np.zeros((push + 2 + turning, 2))
    control[:push, 0], control[push + 2 :, 1] = length / push / SAMPLE_PERIOD_S, speed
    result = _drive(
        rod,
        tube(axis, 1.3 * radius, spacing_mm=0.1),
        control,
        entry_mm=-_WHIP_LEAD_MM,
        inserted_length_mm=0.0,
        friction=0.0,
        config=SimulatorConfig(threads=1, wall_stiffness_n_mm=20.0),
        free_behind_mm=size,
    )
    w, x, y, z = result["attitude"][push + 2 :, 0].T
    first = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], axis=1)
    third = np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], axis=1)
    up = np.tile([0.0, 0.0, 1.0], (len(w), 1))  # normal to the vessel's plane; the first director starts along -z
    angle = np.arctan2(np.sum(first * np.cross(third, up), axis=1), first[:, 2]) - np.pi
    angle = np.unwrap(angle + 2 * np.pi / 3 * -np.arange(len(angle))) + 2 * np.pi / 3 * np.arange(len(angle))
    angle -= 2 * np.pi * np.round(angle[0] / (2 * np.pi))  # a tip may snap ahead by up to 300° in a sample, not back
    return Turned(_advance(speed, turning), angle, result["base_torque"][push + 2 :])


def whip_theory(
    curved_mm: float, tip_rad: Float[np.ndarray, "n"]
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Return the turn of the drive (rad) and its torque (N·mm) at which the tip has turned by `tip_rad`.

    GJ θ″ = EI κ₀ κ_t sin θ with θ′ = 0 at the tip, for a wire that fills its vessel (for tubes within each other:
    P. E. Dupont et al., IEEE Trans. Robotics 26 (2010) 209-225). The straight part ahead of the drive twists too.

    Args:
        curved_mm: length of the curved part, mm.
        tip_rad: turns of the tip, rad.
    """
    couple = WHIP_BEND_N_MM2 / CURVE_RADIUS_MM**2
    drive, torque = np.empty(len(tip_rad)), np.empty(len(tip_rad))
    for i, tip in enumerate(tip_rad):
        end = solve_ivp(
            lambda _, y: [y[1], couple / WHIP_TWIST_N_MM2 * np.sin(y[0])], [0, curved_mm], [tip, 0.0], rtol=1e-8
        ).y[:, -1]
        drive[i], torque[i] = end[0] + end[1] * _WHIP_LEAD_MM, WHIP_TWIST_N_MM2 * end[1]
    return drive, torque


def _advance(speed: float, samples: int) -> Float[np.ndarray, "samples"]:
    return speed * SAMPLE_PERIOD_S * (1 + np.arange(samples))


def _uniform(nodes: int, size_mm: float, bend: float, twist: float, *, shear: float, stretch: float) -> RodLayout:
    """Return a straight rod of 0.2 mm radius with one stiffness and next to no drag."""
    section = {"bend_n_mm2": bend, "twist_n_mm2": twist, "shear_n": shear, "stretch_n": stretch}
    return uniform_rod(nodes, size_mm, **section, radius_mm=0.2, drag_n_s_mm=1e-6, spin_drag_n_mm_s=1e-8)


def _chamber(depth_mm: float, radius_mm: float) -> DistanceMap:
    """Return the distance map of a round chamber along x that a plate closes at x = depth."""
    spacing_mm = 0.2
    low = np.array([-4.0, -radius_mm - 1, -radius_mm - 1])
    high = np.array([depth_mm + 1.5, radius_mm + 1, radius_mm + 1])
    shape = np.ceil((high - low) / spacing_mm).astype(int) + 1
    x, y, z = (low[i] + spacing_mm * np.arange(shape[i]) for i in range(3))
    side = radius_mm - np.hypot(y[None, :, None], z[:, None, None])
    inside = np.minimum(depth_mm - x[None, None, :], side)
    return DistanceMap(values=np.maximum(inside, _OUTSIDE_MM), spacing_mm=spacing_mm, origin_mm=low)


def _drive(
    rod: RodLayout,
    field: DistanceMap,
    control: Float[np.ndarray, "samples 2"],
    *,
    entry_mm: float,
    inserted_length_mm: float,
    friction: float,
    config: SimulatorConfig,
    approach: bool = False,
    free_behind_mm: float = 3.0,
    loading: Loading | None = None,
) -> dict[str, np.ndarray]:
    """Drive one rod along x from `entry_mm` on the x axis; return the core's arrays without the world axis.

    Raises:
        RuntimeError: the rod core did not converge.
    """
    return driven(
        rod,
        control,
        initial=np.array([inserted_length_mm, 0.0]),
        config=config,
        loading=loading,
        lumen=make_lumen(field, float(rod.radius_mm[0])),
        friction=friction,
        insertion=Insertion(position=np.array([entry_mm, 0.0, 0.0]), direction=np.array([1.0, 0.0, 0.0])),
        approach=approach,
        free_behind_mm=free_behind_mm,
        push_limit_n=100.0,  # the drive of a scenario does not slip
    )
