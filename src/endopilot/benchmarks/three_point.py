"""Three-point bending of a wire: what a wire between two supports bends by under a load in the middle."""

from __future__ import annotations

import numpy as np

from endopilot import _core
from endopilot.devices.device import Device
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.core import run_core
from endopilot.simulation.rod import POISSON_RATIO, SHEAR_CORRECTION, RodLayout
from endopilot.types import Insertion

SPAN_MM = 40.0
"""Distance of the supports in the published tests, mm."""
_ELEMENTS = 40
_STATIC = SimulatorConfig(time_step_s=0.5, tolerance_mm=1e-7, threads=1)
_DRAG = 1e-12


def flexural_modulus(device: Device, *, at_mm: float, deflection_mm: float, diameter_mm: float) -> float:
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
    size = half / (_ELEMENTS - 0.5)  # half of the clamped element is held
    abscissa = size * np.arange(_ELEMENTS + 1)
    nodes = len(abscissa)
    bend, twist = (
        float(device.bend_stiffness(np.array([at_mm]))[0]),
        float(device.twist_stiffness(np.array([at_mm]))[0]),
    )
    stretch = 16.0 * bend / device.diameter_mm**2
    rod = RodLayout(
        abscissa_mm=abscissa,
        shear_n=np.full(nodes, SHEAR_CORRECTION * stretch / (2 * (1 + POISSON_RATIO))),
        stretch_n=np.full(nodes, stretch),
        bend_n_mm2=np.full(nodes, bend),
        twist_n_mm2=np.full(nodes, twist),
        rest_curvature=np.zeros((nodes, 3)),
        radius_mm=np.full(nodes, device.tip_radius_mm),
        drag_n_s_mm=np.full(nodes, _DRAG),
        spin_drag_n_mm_s=np.full(nodes, _DRAG),
    )
    load = 48 * bend * deflection_mm / SPAN_MM**3
    force, zero = np.zeros((nodes, 3)), np.zeros((nodes, 3))
    force[0, 1] = load / 2
    result = run_core(
        rod,
        None,
        Insertion(position=np.zeros(3), direction=np.array([1.0, 0.0, 0.0])),
        config=_STATIC,
        initial=np.array([[half, 0.0]]),
        control=np.zeros((1, 4, 2)),
        friction=np.zeros(1),
        loads=_core.make_loads(
            force=force,
            moment=zero,
            spring=zero,
            anchor=zero,
            hold=np.zeros(nodes),
            attitude=np.tile([1.0, 0.0, 0.0, 0.0], (nodes, 1)),
        ),
        lanes=1,
        approach=False,
        free_behind_mm=half,
    )
    if not result["valid"].all():
        raise RuntimeError(f"the bending test of device {device.name} did not converge")
    moved = float(result["tip_position"][0, -1, 0, 1])
    section = np.pi * diameter_mm**4 / 64
    return load * SPAN_MM**3 / (48 * moved * section) / 1000
