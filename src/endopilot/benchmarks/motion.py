"""Speed of the rod core where the vessel moves, beside that where it lies still, on the same worlds."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

import numpy as np

from endopilot.benchmarks.scenes import SAMPLES, WORLDS, make_scenes
from endopilot.simulation.config import PRESETS, Preset
from endopilot.simulation.motion import Motion
from endopilot.simulation.simulate import simulate
from endopilot.types import SAMPLE_PERIOD_S, Rollout

LEAST_SHARE = 0.5
"""Of the real-time factor in a still vessel, that in a moving one must reach."""
COMPARED = 2
"""Worlds of each scene that the error in time is measured on."""
REPEATS = 3
"""Times that the worlds are simulated for the timing; the fastest counts."""


def bench_motion(
    motion: Motion, preset: Preset = "default", *, worlds: int = WORLDS, samples: int = SAMPLES
) -> dict[str, Any]:
    """Drive the reference's wire at random through three synthetic patients that move, and through the same at rest.

    Args:
        motion: of each vessel about its ostium.
        preset: name of the settings.
        worlds: of each patient.
        samples: of each world.

    Returns:
        `realtime_factor_per_core` (simulated seconds per second of processor time on one thread) in the moving vessels,
        that in the still ones, in turns with it, and `share`, the first over the second, with its `bar` and whether it
        `passed`; the share of valid worlds, the iterations a time step, the largest wall force, and the tip's error in
        time: against a time step of 1 ms, on a few of the worlds.
    """
    scenes, config = make_scenes(worlds, samples), replace(PRESETS[preset], threads=1)
    simulated = SAMPLE_PERIOD_S * sum(scene.control.shape[0] * scene.control.shape[1] for scene in scenes)

    def run(moves: Motion | None, count: int | None = None, step_s: float = config.time_step_s) -> list[Rollout]:
        finer = replace(config, time_step_s=step_s, tolerance_mm=config.tolerance_mm if count is None else 1e-6)
        return [
            simulate(
                scene.anatomy,
                scene.device,
                scene.control[:count],
                initial=scene.initial[:count],
                config=finer,
                motion=moves,
            )
            for scene in scenes
        ]

    seconds: dict[bool, list[float]] = {True: [], False: []}
    rollouts: list[Rollout] = []
    for _ in range(REPEATS):
        for moves in (False, True):
            begun = time.process_time()
            rollouts = run(motion if moves else None)
            seconds[moves].append(time.process_time() - begun)
    moving, still = min(seconds[True]), min(seconds[False])
    fine = run(motion, COMPARED, 1e-3)
    error = np.concatenate(
        [
            np.linalg.norm(exact.tip_position - coarse.tip_position[:COMPARED], axis=-1)[
                exact.valid & coarse.valid[:COMPARED]
            ]
            for coarse, exact in zip(rollouts, fine, strict=True)
        ]
    )
    return {
        "preset": preset,
        "realtime_factor_per_core": round(simulated / moving, 1),
        "still_realtime_factor_per_core": round(simulated / still, 1),
        "share": round(still / moving, 3),
        "bar": LEAST_SHARE,
        "passed": still / moving >= LEAST_SHARE,
        "valid_worlds": round(float(np.mean([rollout.valid[:, -1].mean() for rollout in rollouts])), 5),
        "iterations_per_step": round(float(np.mean([r.iterations[r.valid].mean() for r in rollouts])), 3),
        "largest_wall_force_n": round(max(float(r.wall_force[r.valid].max()) for r in rollouts), 4),
        "tip_error_median_mm": round(float(np.median(error)), 5),
        "tip_error_p95_mm": round(float(np.percentile(error, 95)), 5),
        "worlds": sum(len(scene.control) for scene in scenes),
    }
