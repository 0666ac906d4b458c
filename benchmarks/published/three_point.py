"""Three-point bending of a wire: what a wire between two supports bends by under a load in the middle."""

from __future__ import annotations

import numpy as np

from endopilot.devices.device import Wire
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.rod import POISSON_RATIO, SHEAR_CORRECTION
from endopilot.verification.free_rod import Loading, driven, straight_rod

SPAN_MM = 40.0
"""Distance of the supports in the published tests, mm."""
_ELEMENTS = 40
_STATIC = SimulatorConfig(time_step_s=0.5, tolerance_mm=1e-7, threads=1)


def flexural_modulus(device: Wire, *, at_mm: float, deflection_mm: float, diameter_mm: float) -> float:
    """Bend a wire between two supports, and return the modulus that the test finds, GPa.

    The test takes the section as full and round: E = F L³ / (48 δ I), I = π d⁴ / 64. Half the span is simulated,
    clamped in the middle and loaded by half the force at its support; the wire is taken as uniform over the span.

    Args:
        device: the wire.
        at_mm: place of the load, mm from the tip.
        deflection_mm: about how far the middle is pushed, mm.
        diameter_mm: the diameter that the section is computed from, mm.

    Raises:
        RuntimeError: the rod core did not converge.
    """
    half = SPAN_MM / 2
    bend, twist = (float(of(np.array([at_mm]))[0]) for of in (device.bend_stiffness, device.twist_stiffness))
    stretch = 16.0 * bend / device.diameter_mm**2
    rod = straight_rod(
        elements=_ELEMENTS,
        length_mm=half,
        bend=bend,
        twist=twist,
        shear=SHEAR_CORRECTION * stretch / (2 * (1 + POISSON_RATIO)),
        stretch=stretch,
        radius_mm=device.tip_radius_mm,
        clamp=1,
    )
    load = 48 * bend * deflection_mm / SPAN_MM**3
    loading = Loading.none(len(rod.abscissa_mm))
    loading.force_n[0, 1] = load / 2
    result = driven(
        rod,
        np.zeros((4, 2)),
        initial=np.array([half, 0.0]),
        config=_STATIC,
        loading=loading,
        free_behind_mm=half,
    )
    moved = float(result["tip_position"][-1, 1])
    section = np.pi * diameter_mm**4 / 64
    return load * SPAN_MM**3 / (48 * moved * section) / 1000
