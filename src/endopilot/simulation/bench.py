"""Speed and accuracy of the rod core on one reference scenario, measured together."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

import numpy as np

from endopilot.anatomy.atlas import AtlasConfig, synthesize_one
from endopilot.simulation.controls import ControlConfig, random_controls
from endopilot.simulation.device import read_device
from endopilot.simulation.simulator import SimulatorConfig, simulate
from endopilot.types import SAMPLE_PERIOD_S, Rollout

DEVICE = "workhorse-014"
WORLDS = 32
"""Worlds that are timed."""
COMPARED = 8
"""Worlds that the tip error is measured on."""
SAMPLES = 120
"""60 s."""


def bench_simulation() -> dict[str, Any]:
    """Measure the rod core: a synthetic right coronary artery, the 0.014-inch workhorse wire, 60 s of random controls.

    Returns:
        `realtime_factor_per_core` (simulated seconds per second of processor time on one thread,
        everything that `simulate` does included),
        `tip_error_mean_mm`, `tip_error_p95_mm` and `tip_error_max_mm` against the same scenario at a time step of 1 ms
        and a Newton tolerance of 1e-8 mm, `threads_speedup` (two threads against one), and beside them the iterations a
        time step, the share of valid worlds and the largest wall forces.
    """
    anatomy, device = synthesize_one(AtlasConfig(), 0), read_device(DEVICE)
    longest = float(anatomy.tree.longest_path().abscissa[-1])
    initial, control = random_controls(
        ControlConfig(), n_sequences=WORLDS, n_samples=SAMPLES, seed=0, max_inserted_length_mm=longest
    )

    def run(worlds: int, config: SimulatorConfig) -> tuple[Rollout, float, float]:
        wall, processor = time.perf_counter(), time.process_time()
        rollout = simulate(anatomy, device, control[:worlds], initial=initial[:worlds], config=config)
        return rollout, time.perf_counter() - wall, time.process_time() - processor

    one_thread = SimulatorConfig(threads=1)
    _, fixed, _ = run(1, one_thread)  # also warms up
    rollout, alone, processor = run(WORLDS, one_thread)
    _, together, _ = run(WORLDS, replace(one_thread, threads=2))
    exact, _, _ = run(COMPARED, SimulatorConfig(time_step_s=1e-3, tolerance_mm=1e-8))
    both = exact.valid & rollout.valid[:COMPARED]
    error = np.linalg.norm(exact.tip_position - rollout.tip_position[:COMPARED], axis=-1)[both]
    simulated = WORLDS * SAMPLES * SAMPLE_PERIOD_S
    return {
        "realtime_factor_per_core": round(simulated / processor, 1),
        "tip_error_mean_mm": round(float(error.mean()), 5),
        "tip_error_median_mm": round(float(np.median(error)), 5),
        "tip_error_p95_mm": round(float(np.percentile(error, 95)), 5),
        "tip_error_max_mm": round(float(error.max()), 5),
        "threads_speedup": round(alone / together, 3),
        "iterations_per_step": round(float(rollout.iterations[rollout.valid].mean()), 3),
        "valid_worlds": round(float(rollout.valid[:, -1].mean()), 5),
        "contact_force_p999_n": round(float(np.percentile(rollout.contact_force_max, 99.9)), 4),
        "penetration_p999_mm": round(
            float(np.percentile(rollout.contact_force_max, 99.9)) / one_thread.wall_stiffness_n_mm, 4
        ),
        "seconds_for_one_world": round(fixed, 3),
        "worlds": WORLDS,
    }
