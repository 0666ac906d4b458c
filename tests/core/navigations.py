"""Prints digests of navigations at the level of the core that this process runs; see test_core_levels.py."""

from __future__ import annotations

import hashlib
import json
import sys
from functools import cache

import numpy as np

from benchmarks.verification.contact import bent_tube
from endopilot import _core
from endopilot.devices.device import read_wire
from endopilot.simulation.config import FREE_BEHIND_MM, Actuation, SimulatorConfig
from endopilot.simulation.core import make_lumen, run_core
from endopilot.simulation.rod import lay_out
from endopilot.types import Insertion

WORLDS, SAMPLES = 5, 2
CONFIG = SimulatorConfig(element_mm=1.5, time_step_s=0.025, threads=1)


@cache
def lumen(radius_mm: float) -> _core.Lumen:
    """Return a bent tube as the core takes it."""
    tube = bent_tube(np.pi / 3, radius_mm=1.5, bend_radius_mm=20.0, lead_mm=35.0, spacing_mm=0.3)
    return make_lumen(tube, radius_mm)


def navigate(
    actuation: Actuation, lanes: int, *, worlds: slice = slice(None), walled: bool = True
) -> dict[str, np.ndarray]:
    """Return what the core records of random controls in a bent tube, or without a wall and faster."""
    device, random = read_wire("workhorse-014"), np.random.default_rng(11)
    rod = lay_out(device, element_mm=CONFIG.element_mm, length_mm=90.0 + FREE_BEHIND_MM)
    low, high = ((-4, -2), (8, 2)) if actuation == "velocity" else ((-0.08, -0.2), (0.08, 0.2))
    return run_core(
        rod,
        lumen(device.tip_radius_mm) if walled else None,
        Insertion(np.array([-5.0, 0.0, 0.0]), np.array([1.0, 0.0, 0.0] if walled else [0.6, 0.0, 0.8])),
        config=CONFIG,
        initial=np.column_stack([random.uniform(10, 20, WORLDS), random.uniform(-3, 3, WORLDS)])[worlds],
        control=random.uniform(low, high, (WORLDS, SAMPLES, 2))[worlds] * (1 if walled else 3),
        friction=random.uniform(0.05, 0.2, WORLDS)[worlds],
        actuation=actuation,
        record_shape=True,
        lanes=lanes,
        push_limit_n=device.push_limit_n,
    )


def digest(recorded: dict[str, np.ndarray]) -> str:
    """Return a digest of every bit that was recorded."""
    assert recorded["valid"].all() and (recorded["contact_force_max"] > 0).any()
    return hashlib.sha256(b"".join(recorded[name].tobytes() for name in sorted(recorded))).hexdigest()


if __name__ == "__main__":
    digests = {
        f"{actuation}, {lanes} lanes": digest(navigate(actuation, lanes))
        for actuation in ("velocity", "force")
        for lanes in (1, 4, 8)
    }
    json.dump({"level": _core.LEVEL, "digests": digests}, sys.stdout)
