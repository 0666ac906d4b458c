"""Verification of the rod's stability under twist: Greenhill's long rod and Michell's ring.

Both are measured below the instability, where the rod is at rest: its stiffness against a load in the shape of the
mode falls with the twist, and is continued to zero.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from endopilot.verification.free_rod import (
    Case,
    Curve,
    Loading,
    Picture,
    compare,
    equilibrium,
    extrapolate_to_zero,
    straight_rod,
)

BEND_N_MM2 = 100.0
"""EI of a coronary wire's shaft."""
GREENHILL_ELEMENTS = 1000
GREENHILL_LENGTH_MM = 1000.0
GREENHILL_TENSION_N = 1.0
GREENHILL_SHARES = np.array([0.96, 0.98, 0.99])
RING_ELEMENTS = 60
RING_RADIUS_MM = 10.0
RING_TWIST_RATIO = 10.0
"""GJ/EI of the ring; the larger, the less the clamp has to turn."""
RING_RELAXATION_S = 250.0
"""Time constant of the roll-up, EI against the tip's drag; it is long against the 1 s in which the ring is twisted."""
RING_SHARES = np.array([0.0, 0.5, 0.8, 0.88, 0.96])
"""Share of the critical twist that the clamp is turned by; the tip's creep takes some of it back."""


def greenhill_stiffness(moment: float) -> float:
    """Return the stiffness of a long rod under tension and twist against a load in the shape of Greenhill's mode.

    Args:
        moment: twisting moment, N·mm.

    Returns:
        Load per displacement and length, N/mm².
    """
    tension, length, amplitude_mm = GREENHILL_TENSION_N, GREENHILL_LENGTH_MM, 1e-3
    rod = straight_rod(
        elements=GREENHILL_ELEMENTS,
        length_mm=length,
        bend=BEND_N_MM2,
        twist=100 * BEND_N_MM2,
        shear=1e4,
        stretch=1e5,
    )
    size, wave = rod.abscissa_mm[1], np.sqrt(tension / BEND_N_MM2)
    loading = Loading.none(len(rod.abscissa_mm))
    along = length - rod.abscissa_mm
    helix = np.column_stack([np.cos(wave * along), np.sin(wave * along)])
    pattern = np.sin(np.pi * np.clip(along / length, 0, 1))[:, None] * helix
    strength = amplitude_mm * tension * wave**2  # N/mm
    loading.force_n[:, 1:] = strength * size * pattern
    loading.force_n[0, 0] += tension
    loading.moment_n_mm[0, 2] = moment
    loading.spring_n_mm[:2, 1:] = 1e3  # the tip stays on the axis and along it
    shape = equilibrium(rod, loading, samples=8)["shape"][-1]
    return strength * float((pattern**2).sum() / (pattern * shape[:, 1:]).sum())


def greenhill() -> list[Case]:
    """Compare the moment under which a long rod in tension T loses its straightness with M = 2 sqrt(EI T).

    A. G. Greenhill, Proc. Inst. Mech. Eng. 34 (1883) 182-225. A helix of wave number k has the stiffness
    EI k⁴ - M k³ + T k² per length, which is T²/EI (2 - M / sqrt(EI T)) at k = sqrt(T/EI), the first to vanish. The
    rod is 32 half waves long: clamped ends raise its moment by 0.2 % at most.
    """
    critical = 2 * np.sqrt(BEND_N_MM2 * GREENHILL_TENSION_N)
    moments = critical * GREENHILL_SHARES
    stiffness = np.array([greenhill_stiffness(moment) for moment in moments])
    value = extrapolate_to_zero(stiffness, moments)
    line = critical * np.array([0.95, 1.0])
    formula = GREENHILL_TENSION_N**2 / BEND_N_MM2 * 2 * (1 - line / critical)
    picture = Picture(
        "twisting moment, N mm",
        "stiffness against the mode, N/mm²",
        (
            Curve("T²/EI (2 − M/√(EI T))", line, formula, "reference"),
            Curve("core", moments, stiffness),
            Curve("core, continued to 0", np.array([value]), np.zeros(1), "mark"),
        ),
    )
    return [compare("Greenhill twist buckling M", critical, value, 0.01, picture)]


def twisted_ring(turned: float, load_n_mm: float) -> tuple[float, Float[np.ndarray, "n 3"], Float[np.ndarray, "n"]]:
    """Roll a straight rod up into a ring, twist it, and return its twist (rad), its nodes and the load's shape.

    A moment EI/R on the tip closes the ring, slowly, for the tip's rotation is dragged; springs keep the tip's height
    and slope. Then the clamp is turned quickly: on that time scale the drag holds the tip, and the twist stays. A
    load out of the ring's plane in the shape of Michell's mode, cos 2θ, is there all the time.

    Args:
        turned: angle that the clamp is turned by, rad.
        load_n_mm: amplitude of the load, N/mm.
    """
    n, radius = RING_ELEMENTS, RING_RADIUS_MM
    length = 2 * np.pi * radius
    size = length / (n - 1)  # from the middle of the clamped element to that of the tip's
    rod = straight_rod(
        elements=n,
        length_mm=(n - 0.5) * size,
        bend=BEND_N_MM2,
        twist=RING_TWIST_RATIO * BEND_N_MM2,
        shear=1e4,
        stretch=1e5,
    )
    rod.drag_n_s_mm[0] = 10 * RING_RELAXATION_S * BEND_N_MM2 / length**3
    rod.spin_drag_n_mm_s[0] = RING_RELAXATION_S * BEND_N_MM2 / length
    loading = Loading.none(len(rod.abscissa_mm))
    loading.moment_n_mm[0, 0] = BEND_N_MM2 / radius
    pattern = np.cos(2 * (length - rod.abscissa_mm + 0.5 * size) / radius)
    pattern[n:] = 0.0
    loading.force_n[:, 2] = load_n_mm * size * pattern
    loading.spring_n_mm[:2, 2] = 1e4
    loading.spring_n_mm[(n - 1) // 2, 2] = 1.0  # else the ring's plane could turn freely about the clamp's axis
    rolling = round(13 * RING_RELAXATION_S / 0.5)
    control = np.zeros((rolling + 3, 2))
    control[rolling : rolling + 2, 1] = -turned / 2 / 0.5
    result = equilibrium(rod, loading, control=control)
    attitude = Rotation.from_quat(result["attitude"][-1][:n], scalar_first=True)
    twist = float((attitude[1:].inv() * attitude[:-1]).as_rotvec()[:, 2].sum())
    return twist, result["shape"][-1], pattern


def michell_ring() -> list[Case]:
    """Compare the twist under which a ring of a straight rod leaves its plane with Tw = 2π sqrt(3) EI/GJ.

    J. H. Michell, Messenger of Mathematics 11 (1890) 181-184; A. Goriely, J. Elasticity 84 (2006) 281-299. The
    stiffness against the mode cos 2θ falls as 1 - (Tw/Tw_critical)².
    """
    critical = 2 * np.pi * np.sqrt(3) / RING_TWIST_RATIO
    strength = 1e-3 * BEND_N_MM2 / RING_RADIUS_MM**4
    twists, stiffness = [], []
    for share in RING_SHARES:
        twist, up, pattern = twisted_ring(share * critical, strength)
        _, down, _ = twisted_ring(share * critical, -strength)
        twists.append(twist)
        stiffness.append(2 * strength * (pattern**2).sum() / (pattern * (up - down)[:, 2]).sum())
    twists, stiffness = np.array(twists), np.array(stiffness)
    value = np.sqrt(extrapolate_to_zero(stiffness[-3:], twists[-3:] ** 2))
    line = critical * np.linspace(0, 1, 101)
    picture = Picture(
        "twist, rad",
        "stiffness / that of the untwisted ring",
        (
            Curve("1 − (Tw / 2π√3 EI/GJ)²", line, 1 - (line / critical) ** 2, "reference"),
            Curve("core", twists, stiffness / stiffness[0]),
            Curve("core, continued to 0", np.array([value]), np.zeros(1), "mark"),
        ),
    )
    return [compare("Michell ring Tw", critical, value, 0.01, picture)]


CASES = (greenhill, michell_ring)
