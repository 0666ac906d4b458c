"""Verification of what lies between drive and ostium: a uniform device that twists under Coulomb friction.

Length L, torsional stiffness GJ, friction torque a length m; s counts from the drive. Where the device turns, its
torque T falls by m a length towards the ostium; where friction holds it, T stays as it was. The rod ahead of the ostium
hardly twists: it is free, or held by a spring against rotation.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from endopilot.simulation.core import run_core
from endopilot.simulation.rod import make_transmission
from endopilot.verification.free_rod import STATIC, X_AXIS, Case, Curve, Loading, Picture, compare, straight_rod

LENGTH_MM, TWIST_N_MM2, FRICTION_N_MM_MM = 1000.0, 80.0, 2e-4
"""L, GJ and m."""
LAG_RAD = FRICTION_N_MM_MM * LENGTH_MM**2 / (2 * TWIST_N_MM2)
"""By which a device that is free at the ostium lags while it turns."""
AMPLITUDE_RAD = 12.0
"""Of the drive's turns to and fro, far more than the lag."""
RADIUS_MM = 0.1
HOLD_N_MM = 0.01
"""Spring against rotation ahead of the ostium, N·mm/rad."""


def turn(
    path_rad: Float[np.ndarray, "steps"], *, hold_n_mm: float = 0.0, slide_mm: Float[np.ndarray, "_"] | None = None
) -> tuple[Float[np.ndarray, "steps"], Float[np.ndarray, "steps"]]:
    """Return the rotation at the ostium (rad) and the drive's torque (N·mm) where the drive has turned along a path.

    Args:
        path_rad: rotation of the drive after each step, rad; it begins at 0.
        hold_n_mm: spring that holds the rod ahead of the ostium, N·mm/rad.
        slide_mm: advance in each step, mm.
    """
    rod = straight_rod(elements=8, length_mm=10.0, bend=1.0, twist=1e4, radius_mm=RADIUS_MM)
    loading = Loading.none(len(rod.abscissa_mm))
    loading.hold_n_mm[0] = hold_n_mm
    half = np.sqrt(0.5)
    loading.attitude[:] = [half, 0.0, half, 0.0]  # along x, as the clamp holds it
    control = np.zeros((1, len(path_rad), 2))
    control[0, :, 1] = np.diff(path_rad, prepend=0.0) / 0.5
    if slide_mm is not None:
        control[0, :, 0] = slide_mm / 0.5
    inserted = (len(rod.abscissa_mm) - 3 - 0.5) * float(rod.abscissa_mm[1])
    result = run_core(
        rod,
        None,
        X_AXIS,
        config=replace(STATIC, sample_tolerance_mm=1e-8, introducer_friction_n=0.0, introducer_drag_n_s_mm=0.0),
        initial=np.array([[inserted, 0.0]]),
        control=control,
        friction=np.zeros((1, 1)),
        loads=loading.core() if hold_n_mm else None,
        lanes=1,
        approach=False,
        free_behind_mm=0.0,
        transmission=make_transmission(
            length_mm=np.array([LENGTH_MM]),
            friction_n_mm_mm=np.array([FRICTION_N_MM_MM]),
            twist_n_mm2=np.full((1, 2), TWIST_N_MM2),
        ),
    )
    if not result["valid"].all():
        raise RuntimeError("a verification case did not converge")
    return result["rotation"][0, :, 0], result["drive_torque"][0, :, 0]


def steady_lag() -> list[Case]:
    """Turn steadily: T = T₀ + m (L - s), and so the rotation at the ostium lags by T₀ L/GJ + m L²/2GJ."""
    cases = []
    for name, hold, end in (("free", 0.0, 2 * LAG_RAD), ("against a torque", 5 * HOLD_N_MM, 2.8)):
        path = np.linspace(0.0, end, 141)[1:]
        rotation, torque = turn(path, hold_n_mm=hold)
        at_ostium = hold * np.sin(rotation)  # of a spring towards an attitude
        lag = at_ostium * LENGTH_MM / TWIST_N_MM2 + LAG_RAD
        moves = rotation > 1e-6
        curves = (
            Curve("closed form", path[moves], path[moves] - lag[moves], "reference"),
            Curve("core", path, rotation),
        )
        picture = Picture("drive turned, rad", "rotation at the ostium, rad", curves)
        cases.append(compare(f"transmission: lag, {name}", lag[-1], path[-1] - rotation[-1], 1e-3, picture))
        needed = at_ostium[-1] + FRICTION_N_MM_MM * LENGTH_MM
        cases.append(compare(f"transmission: torque of the drive, {name}", needed, torque[-1], 1e-3))
    return cases


def front() -> list[Case]:
    """Turn a device at rest: it turns as far as a front at s = √(2 GJ φ/m), with T = m (s - s'), so φ = T²/2 m GJ.

    The chain meets this where the front reaches the middle of a section.
    """
    path = np.linspace(0.0, LAG_RAD, 129)[1:]
    torque = turn(path)[1]
    closed = np.sqrt(2 * FRICTION_N_MM_MM * TWIST_N_MM2 * path)
    curves = (Curve("closed form", path, closed, "reference"), Curve("core", path, torque))
    picture = Picture("drive turned, rad", "torque of the drive, N mm", curves)
    return [
        compare(f"transmission: torque with the front at {share:g} L", closed[at], torque[at], 1e-3, picture)
        for share in (0.5, 1.0)
        for at in [int(share**2 * len(path)) - 1]
    ]


def reversal() -> list[Case]:
    """Turn to and fro: the ostium follows after twice the lag, m L²/GJ, and a cycle takes 4 m L (A - m L²/3GJ).

    After a reversal the device turns back as far as a front, behind which T has changed by 2 m (s - s'). A place at s
    slips in half a cycle by 2 A - 2 m (L s - s²/2)/GJ, against m; A is the drive's amplitude.
    """
    quarter = np.linspace(0.0, AMPLITUDE_RAD, 401)
    path = np.concatenate([quarter, quarter[-2::-1], -quarter[1:], -quarter[-2::-1], quarter[1:]])[1:]
    rotation, torque = turn(path)
    top, bottom, again = 399, 1199, 1999  # where the drive turns back
    moved = rotation[top] - rotation[top:bottom]
    first = int(np.flatnonzero(moved > 1e-6)[0])
    band = float(path[top] - path[top + first] - moved[first])
    work = float(np.trapezoid(torque[top : again + 1], path[top : again + 1]))
    lost = 4 * FRICTION_N_MM_MM * LENGTH_MM * (AMPLITUDE_RAD - 2 * LAG_RAD / 3)
    follows = np.array([AMPLITUDE_RAD, AMPLITUDE_RAD - 2 * LAG_RAD, -AMPLITUDE_RAD])
    curves = (
        Curve("closed form", follows, np.array([1.0, 1.0, -1.0]) * (AMPLITUDE_RAD - LAG_RAD), "reference"),
        Curve("core", path[top : again + 1], rotation[top : again + 1]),
    )
    picture = Picture("drive turned, rad", "rotation at the ostium, rad", curves)
    return [
        compare("transmission: dead band after a reversal", 2 * LAG_RAD, band, 1e-3, picture),
        compare("transmission: energy lost in a cycle", lost, work, 2e-3),
    ]


def sliding() -> list[Case]:
    """Turn, then slide by x at rest: friction along the path leaves m r dθ/dx against rotation, and twist diffuses.

    GJ θ'' = m r dθ/dx with θ = 0 at the drive and θ' = 0 at the ostium, from the steady lag m (L s - s²/2)/GJ on: the
    lag at the ostium is (m/GJ) Σ (-1)ⁿ 2/(L k³) exp(-k² GJ x/(m r)) with k = (n + 1/2) π/L.
    """
    turning, steps = 60, 200
    slides = np.concatenate([np.zeros(turning), np.full(steps, 0.001)])
    path = np.concatenate([np.linspace(0.0, 2 * LAG_RAD, turning + 1)[1:], np.full(steps, 2 * LAG_RAD)])
    lag = path[-1] - turn(path, slide_mm=slides)[0][turning - 1 :]
    x, n = np.concatenate([[0.0], np.cumsum(slides[turning:])]), np.arange(60)[:, None]
    k = (n + 0.5) * np.pi / LENGTH_MM
    fall = np.exp(-(k**2) * TWIST_N_MM2 * x / (FRICTION_N_MM_MM * RADIUS_MM))
    closed = FRICTION_N_MM_MM / TWIST_N_MM2 * np.sum((-1.0) ** n * 2 / (LENGTH_MM * k**3) * fall, axis=0)
    curves = (Curve("closed form", x, closed, "reference"), Curve("core", x, lag))
    picture = Picture("slid, mm", "lag at the ostium, rad", curves)
    return [compare("transmission: lag left after sliding", closed[-1], lag[-1], 0.02, picture)]


CASES = (steady_lag, front, reversal, sliding)
