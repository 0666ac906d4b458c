"""Speed of the rod core on a GPU, and how closely it agrees with the processor."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

import numpy as np

from endopilot.atlas.atlas import AtlasConfig, make_patient
from endopilot.devices.device import read_wire
from endopilot.simulation.config import FREE_BEHIND_MM, PRESETS, Preset, SimulatorConfig, core_for
from endopilot.simulation.controls import ControlConfig, random_controls
from endopilot.simulation.core import make_lumen, run_core
from endopilot.simulation.rod import lay_out
from endopilot.types import SAMPLE_PERIOD_S

DEVICE = "workhorse-014"
WORLDS = (1000, 10_000, 100_000)
"""Numbers of worlds that are timed."""
DRAWN = 1000
"""Navigations that are drawn; more worlds repeat them, with frictions of their own."""
COMPARED = 64
"""Worlds that are stepped on the processor too."""
SAMPLES = 40
"""20 s."""
BAR_WORLDS, BAR_FACTOR = 10_000, 100
"""So many wires are to run at so many times real time each."""


def bench_gpu(
    preset: Preset = "default", worlds: tuple[int, ...] = WORLDS, samples: int = SAMPLES
) -> list[dict[str, Any]]:
    """Measure the core on a CUDA GPU on one anatomy of `bench_simulation`, without the projection of tips.

    The clock runs from the arrays of controls to the arrays of records, with the copies to the GPU and back.

    Args:
        preset: name of the settings.
        worlds: numbers of worlds.
        samples: of each navigation, 0.5 s long.

    Returns:
        A row for each number of worlds: `worlds`, `seconds`, `realtime_factor` (simulated seconds of all wires per
        second), `realtime_factor_per_wire`, `valid_worlds`; distance of the tips from those of the processor over the
        first worlds, `tip_distance_median_mm`, `tip_distance_p95_mm` and `tip_distance_max_mm`; `passed`, whether the
        bar of 10 000 wires at 100 times real time each is met, None for other numbers.

    Raises:
        InputError: there is no GPU, or no build of the core for it.
    """
    core_for("cuda")  # refuses at once where there is none
    anatomy, device = make_patient(AtlasConfig(population="textbook"), 0), read_wire(DEVICE)
    longest = float(anatomy.tree.longest_path().abscissa[-1])
    initial, control = random_controls(
        ControlConfig(), n_sequences=min(DRAWN, max(worlds)), n_samples=samples, seed=0, max_inserted_length_mm=longest
    )
    friction = np.random.default_rng(0).uniform(0.8, 1.2, max(worlds)) * device.friction
    on_gpu = replace(PRESETS[preset], processor="cuda")

    def run(count: int, config: SimulatorConfig) -> dict[str, np.ndarray]:
        chosen = np.arange(count) % len(initial)
        return run_core(
            lay_out(device, element_mm=config.element_mm, length_mm=longest + FREE_BEHIND_MM),
            make_lumen(anatomy.distance_map, device.tip_radius_mm, config.processor),
            anatomy.insertion,
            config=config,
            initial=initial[chosen, 0],
            control=control[chosen, :, 0],
            friction=friction[:count],
            push_limit_n=device.push_limit_n,
            pull_limit_n=device.pull_limit_n,
            torque_limit_n_mm=device.torque_limit_n_mm,
        )

    compared = min(COMPARED, *worlds)
    run(compared, on_gpu)  # the first call loads the kernel
    exact = run(compared, replace(on_gpu, processor="cpu"))
    rows = []
    for count in worlds:
        started = time.perf_counter()
        result = run(count, on_gpu)
        seconds = time.perf_counter() - started
        both = exact["valid"] & result["valid"][:compared]
        distance = np.linalg.norm(exact["tip_position"] - result["tip_position"][:compared], axis=-1)[..., 0][both]
        factor = samples * SAMPLE_PERIOD_S / seconds
        rows.append(
            {
                "worlds": count,
                "seconds": round(seconds, 3),
                "realtime_factor": round(count * factor, 2),
                "realtime_factor_per_wire": round(factor, 2),
                "valid_worlds": round(float(result["valid"][:, -1].mean()), 5),
                "tip_distance_median_mm": float(np.median(distance)),
                "tip_distance_p95_mm": float(np.percentile(distance, 95)),
                "tip_distance_max_mm": float(distance.max()),
                "passed": factor >= BAR_FACTOR if count == BAR_WORLDS else None,
            }
        )
    return rows
