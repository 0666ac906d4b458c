"""Speed and accuracy of the rod core on one reference scenario, measured together."""

from __future__ import annotations

import os
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from endopilot.atlas.atlas import AtlasConfig, make_patient
from endopilot.simulation.config import SimulatorConfig, wall_stiffness
from endopilot.simulation.controls import ControlConfig, random_controls
from endopilot.simulation.device import read_device
from endopilot.simulation.simulate import simulate
from endopilot.simulation.simulator import Simulator
from endopilot.types import SAMPLE_PERIOD_S, Rollout

DEVICE = "workhorse-014"
WORLDS = 32
"""Worlds that are timed."""
COMPARED = 16
"""Worlds that the tip error is measured on."""
SAMPLES = 120
"""60 s."""


def bench_simulation() -> dict[str, Any]:
    """Measure the rod core: a synthetic right coronary artery, the 0.014-inch workhorse wire, 60 s of random controls.

    Returns:
        `realtime_factor_per_core` (simulated seconds per second of processor time on one thread, including
        everything that `simulate` does),
        `tip_error_mean_mm`, `tip_error_p95_mm` and `tip_error_max_mm` against the same scenario at a time step of 1 ms
        and a Newton tolerance of 1e-8 mm, `threads_speedup` (two threads against one), and beside them the iterations a
        time step, the share of valid worlds, the largest wall forces and `seconds_for_first_call`: of one world and
        sample, the first call after the imports.
    """
    anatomy, device = make_patient(AtlasConfig(), 0), read_device(DEVICE)
    longest = float(anatomy.tree.longest_path().abscissa[-1])
    initial, control = random_controls(
        ControlConfig(), n_sequences=WORLDS, n_samples=SAMPLES, seed=0, max_inserted_length_mm=longest
    )

    def run(worlds: int, config: SimulatorConfig) -> tuple[Rollout, float, float]:
        wall, processor = time.perf_counter(), time.process_time()
        rollout = simulate(anatomy, device, control[:worlds], initial=initial[:worlds], config=config)
        return rollout, time.perf_counter() - wall, time.process_time() - processor

    one_thread = SimulatorConfig(threads=1)
    started = time.perf_counter()
    simulate(anatomy, device, np.zeros((1, 1, 2)), config=one_thread)
    first_call = time.perf_counter() - started
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
            float(np.percentile(rollout.contact_force_max, 99.9)) / wall_stiffness(one_thread, device.push_limit_n), 4
        ),
        "seconds_for_first_call": round(first_call, 3),
        "worlds": WORLDS,
    }


def bench_scaling() -> list[dict[str, Any]]:
    """Measure how cost and memory grow with the wire's elements and with the number of worlds, on one thread.

    Returns:
        Rows of `elements`, `worlds`, `seconds` (processor time of the core), `us_per_node_and_iteration` (of the nodes
        ahead of the catheter) and `kilobytes_per_world` (growth of the process's memory; the map is shared).
    """
    anatomy, device = make_patient(AtlasConfig(), 0), read_device(DEVICE)
    depth = 0.6 * float(anatomy.tree.longest_path().abscissa[-1])
    rows = []
    for elements, worlds in (*((n, 64) for n in (50, 100, 200, 400)), *((100, n) for n in (1, 10, 100, 1000, 10_000))):
        config = SimulatorConfig(elements=elements, threads=1)
        before = _resident_kilobytes()
        simulator = Simulator(anatomy, device, worlds=worlds, config=config)
        simulator.reset(inserted_length=np.full(worlds, depth), rotation=np.zeros(worlds))
        speed = np.column_stack([np.linspace(2, 8, worlds), np.linspace(-2, 2, worlds)])
        memory = (_resident_kilobytes() - before) / worlds
        started = time.process_time()
        steps = 0.1 / config.time_step_s
        iterations = sum(steps * float(simulator.step(speed, 0.1).iterations.sum()) for _ in range(10))
        spent = time.process_time() - started
        active = float(np.mean(simulator.active_nodes))
        rows.append(
            {
                "elements": elements,
                "worlds": worlds,
                "seconds": round(spent, 3),
                "us_per_node_and_iteration": round(1e6 * spent / float(iterations * active), 4),
                "kilobytes_per_world": round(memory, 1),
            }
        )
    return rows


def _resident_kilobytes() -> float:
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1024
