"""The tip-load test: a device's tip pushed against a plate until it buckles, as catalogues state it in gram-force.

There is no common protocol; as usually described, the wire is held 10 mm behind its tip, upright on a balance's smooth
plate, and lowered until the straight tip buckles as a clamped-free column at F = π² EI / (4 L²) (S. P. Timoshenko and
J. M. Gere, Theory of Elastic Stability, 1961, §2.1), the formula that the shipped devices' EI at the tip is computed
from. The test takes the whole stiffness profile, so a taper that begins ahead of 10 mm is held to its catalogue too.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from endopilot.devices.device import GRAM_FORCE_N, Wire, read_wire
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.core import Loading, run_core
from endopilot.simulation.rod import rod_at
from endopilot.types import Insertion

HELD_MM = 10.0  # distance from the tip at which the test holds the wire, mm
TOLERANCE = 0.05  # relative error of the simulated tip load against the catalogue's that passes
_ELEMENTS = 40
_PLATE_N_MM = 100.0  # stiffness of the plate, N/mm: a tip load moves it by some µm
_PUSH_SHARE = 0.02  # of the length, lowered; a buckled column's load grows by half of it, 1 %
_SAMPLES = 20
_IMPERFECTION = 1e-3  # sideways load as a share of the buckling load: no real tip is perfectly straight
_STATIC = SimulatorConfig(time_step_s=0.5, tolerance_mm=1e-7, threads=1)  # each sample is an equilibrium
_DRAG = 1e-12


@dataclass(frozen=True, eq=False)
class TipLoadTest:
    """A simulated tip-load test: how far the holder was lowered, mm, the force on the plate, N, the wire's nodes at the
    end, from tip to holder along x on a plate at x = 10, mm, and the tip load, the largest force, N."""

    pushed_mm: Float[np.ndarray, "samples"]
    force_n: Float[np.ndarray, "samples"]
    shape_mm: Float[np.ndarray, "nodes 3"]
    load_n: float


def simulate_tip_load(wire: Wire | str | Path) -> TipLoadTest:
    """Push the distal 10 mm of a wire (or its name, or its YAML file), straight, against a smooth plate until it
    buckles; RuntimeError if the rod core did not converge."""
    wire = wire if isinstance(wire, Wire) else read_wire(wire)
    nodes = _ELEMENTS + 1
    size = HELD_MM / (_ELEMENTS - 0.5)  # of the clamped element half is held: it fixes a direction
    at, drag = size * np.arange(nodes), np.full(nodes, _DRAG)
    rod = rod_at(wire, at, at + 0.5 * size, np.zeros((nodes, 3)), drag, drag)
    loading = Loading.none(nodes)
    loading.force_n[0, 1] = _IMPERFECTION * np.pi**2 * wire.bend_stiffness_n_mm2[0] / (4 * HELD_MM**2)
    loading.spring_n_mm[0, 0], loading.anchor_mm[0, 0] = _PLATE_N_MM, HELD_MM
    push = np.zeros((1, _SAMPLES, 2))
    push[..., 0] = _PUSH_SHARE * HELD_MM / _SAMPLES / _STATIC.time_step_s
    result = run_core(
        rod,
        None,
        Insertion(position=np.zeros(3), direction=np.array([1.0, 0.0, 0.0])),
        config=_STATIC,
        initial=np.array([[HELD_MM, 0.0]]),
        control=push,
        friction=np.zeros(1),
        loads=loading.core(),
        record_shape=True,
        lanes=1,
        approach=False,
        free_behind_mm=HELD_MM,  # more than the wire has: its last two nodes are held, and the free length stays
    )
    if not result["valid"].all():
        raise RuntimeError(f"the tip-load test of wire {wire.name} did not converge")
    force = _PLATE_N_MM * (result["tip_position"][0, :, 0, 0] - HELD_MM)
    pushed = _STATIC.time_step_s * np.cumsum(push[0, :, 0])
    return TipLoadTest(pushed, force, result["shape"][0, -1], float(force.max()))


def tip_load_row(device: Wire) -> dict[str, Any]:
    """Return what `endopilot devices --tip-load` shows of a device: the catalogue's tip load, the simulated test's, the
    relative `error`, its `bar` and whether it `passed`; None where the catalogue states no load."""
    load, stated = simulate_tip_load(device).load_n, device.tip_load_n
    error = None if stated is None else load / stated - 1
    shown = device.summary()
    return {
        **{name: shown[name] for name in ("name", "ei_tip_n_mm2", "tip_load_n")},
        "tip_load_gf": None if stated is None else round(stated / GRAM_FORCE_N, 3),
        "tested_tip_load_n": round(load, 5),
        "tested_tip_load_gf": round(load / GRAM_FORCE_N, 3),
        "error": None if error is None else round(error, 4),
        "bar": TOLERANCE,
        "passed": None if error is None else abs(error) <= TOLERANCE,
    }
