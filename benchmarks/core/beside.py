"""Speed of the rod core in some scenario, beside that of the wire alone in the same vessels at rest."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float

from benchmarks.core.scenes import Scene
from endopilot.simulation.config import PRESETS, Preset, SimulatorConfig
from endopilot.types import SAMPLE_PERIOD_S, Rollout

COMPARED = 2
"""Worlds of each scene that the error in time is measured on."""
REPEATS = 3
"""Times that the worlds are simulated for the timing; the fastest counts."""
Run = Callable[[SimulatorConfig, int | None], list[Rollout]]
"""Simulates the scenario: a rollout of the worlds of each scene, or of the first so many of them."""


def bench_beside(
    run: Run, scenes: Sequence[Scene], preset: Preset, *, beside: str, least_share: float
) -> tuple[dict[str, Any], list[Rollout]]:
    """Time a scenario and the wire alone at rest in turns, on one thread.

    Args:
        run: simulates the scenario in the scenes.
        scenes: the vessels, wires and controls of both.
        preset: name of the settings.
        beside: what the figures call the wire alone at rest.
        least_share: of its real-time factor, that the scenario must reach.

    Returns:
        The figures: `realtime_factor_per_core` (simulated seconds per second of processor time) of both, `share`, the
        first over the second, with its `bar` and whether it `passed`; `node_iterations_per_second` of both, the nodes
        evaluated in a simulated second; the share of valid worlds, the iterations a time step and the largest wall
        force (N). And the rollouts that they were taken from.
    """
    config = replace(PRESETS[preset], threads=1)
    simulated = SAMPLE_PERIOD_S * sum(scene.control.shape[0] * scene.control.shape[1] for scene in scenes)
    rollouts: list[Rollout] = []
    still: list[Rollout] = []
    ours, alone = [], []
    for _ in range(REPEATS):
        begun = time.process_time()
        still = [scene.run(config) for scene in scenes]
        alone.append(time.process_time() - begun)
        begun = time.process_time()
        rollouts = run(config, None)
        ours.append(time.process_time() - begun)
    share = min(alone) / min(ours)
    return {
        "preset": preset,
        "realtime_factor_per_core": round(simulated / min(ours), 1),
        f"{beside}_realtime_factor_per_core": round(simulated / min(alone), 1),
        "share": round(share, 3),
        "bar": round(least_share, 3),
        "passed": share >= least_share,
        "node_iterations_per_second": node_iterations_per_second(rollouts),
        f"{beside}_node_iterations_per_second": node_iterations_per_second(still),
        "valid_worlds": round(float(np.mean([rollout.valid[:, -1].mean() for rollout in rollouts])), 5),
        "iterations_per_step": round(float(np.mean([r.iterations[r.valid].mean() for r in rollouts])), 3),
        "largest_wall_force_n": round(max(float(r.wall_force[r.valid].max()) for r in rollouts), 4),
        "worlds": sum(len(scene.control) for scene in scenes),
    }, rollouts


def node_iterations_per_second(rollouts: Sequence[Rollout]) -> float:
    """Return how many nodes are evaluated in a simulated second."""
    simulated_s = SAMPLE_PERIOD_S * sum(rollout.valid.size for rollout in rollouts)
    return round(sum(float(rollout.node_iterations.sum()) for rollout in rollouts) / simulated_s, 1)


def fine_steps(run: Run, preset: Preset) -> list[Rollout]:
    """Return the first worlds of each scene at time steps of 1 ms: what `error_in_time` compares with."""
    return run(replace(PRESETS[preset], time_step_s=1e-3, tolerance_mm=1e-6), COMPARED)


def error_in_time(
    name: str,
    rollouts: Sequence[Rollout],
    fine: Sequence[Rollout],
    tip: Callable[[Rollout], Float[np.ndarray, "worlds samples 3"]],
) -> dict[str, float]:
    """Return the median and 95th percentile of a tip's distance from where it is at fine steps, mm.

    Args:
        name: of the figures.
        rollouts: of all worlds.
        fine: of the first of them, by `fine_steps`.
        tip: takes the tip's positions from a rollout.
    """
    errors = np.concatenate(
        [
            np.linalg.norm(tip(exact) - tip(coarse)[: len(exact.valid)], axis=-1)[
                exact.valid & coarse.valid[: len(exact.valid)]
            ]
            for coarse, exact in zip(rollouts, fine, strict=True)
        ]
    )
    return {
        f"{name}_median_mm": round(float(np.median(errors)), 5),
        f"{name}_p95_mm": round(float(np.percentile(errors, 95)), 5),
    }
