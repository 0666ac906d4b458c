"""Speed of the rod core in some scenario, beside that of the wire alone in the same vessels at rest."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float

from benchmarks.core.scenes import SAMPLES, WORLDS, Scene, make_scenes, simulated_s
from benchmarks.figures import Bar, in_turns, spread
from endopilot.simulation.config import PRESETS, Preset, SimulatorConfig
from endopilot.simulation.motion import Motion
from endopilot.simulation.trajectory import Trajectory
from endopilot.types import SAMPLE_PERIOD_S

COMPARED = 2
"""Worlds of each scene that the error in time is measured on."""
LEAST_SHARE_MOVING = 0.5
"""Of the real-time factor in a still vessel, that in a moving one must reach."""
Run = Callable[[SimulatorConfig, int | None], list[Trajectory]]
"""Simulates the scenario: a rollout of the worlds of each scene, or of the first so many of them."""


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
        The figures of `bench_beside`, and the tip's error in time: against a time step of 1 ms, on a few of the worlds.
    """
    scenes = make_scenes(worlds, samples)
    run = partial(run_all, scenes, motion=motion)
    figures, rollouts = bench_beside(run, scenes, preset, beside="still", least_share=LEAST_SHARE_MOVING)
    return figures | error_in_time("tip_error", rollouts, fine_steps(run, preset))


def bench_beside(
    run: Run, scenes: Sequence[Scene], preset: Preset, *, beside: str, least_share: float
) -> tuple[dict[str, Any], list[Trajectory]]:
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
    (still, _, alone), (rollouts, _, ours) = in_turns(lambda: run_all(scenes, config), lambda: run(config, None))
    bar, share = Bar(least_share, at_least=True), alone / ours
    return {
        "preset": preset,
        "realtime_factor_per_core": round(simulated_s(scenes) / ours, 1),
        f"{beside}_realtime_factor_per_core": round(simulated_s(scenes) / alone, 1),
        "share": round(share, 3),
        "bar": round(bar.limit, 3),
        "passed": bar.met(share),
        **effort(rollouts),
        f"{beside}_node_iterations_per_second": node_iterations_per_second(still),
        "largest_wall_force_n": round(max(float(r.wall_force[r.valid].max()) for r in rollouts), 4),
        "worlds": sum(len(scene.control) for scene in scenes),
    }, rollouts


def run_all(
    scenes: Sequence[Scene], config: SimulatorConfig, worlds: int | None = None, *, motion: Motion | None = None
) -> list[Trajectory]:
    """Simulate the worlds of each scene, or the first of them; the vessels lie still, or move."""
    return [scene.run(config, worlds, motion=motion) for scene in scenes]


def effort(rollouts: Sequence[Trajectory]) -> dict[str, float]:
    """Return the nodes evaluated in a simulated second, the iterations a time step and the share of valid worlds."""
    return {
        "node_iterations_per_second": node_iterations_per_second(rollouts),
        "iterations_per_step": round(float(np.mean([r.iterations[r.valid].mean() for r in rollouts])), 3),
        "valid_worlds": round(float(np.concatenate([r.valid[:, -1] for r in rollouts]).mean()), 5),
    }


def node_iterations_per_second(rollouts: Sequence[Trajectory]) -> float:
    """Return how many nodes are evaluated in a simulated second."""
    simulated = SAMPLE_PERIOD_S * sum(rollout.valid.size for rollout in rollouts)
    return round(sum(float(rollout.node_iterations.sum()) for rollout in rollouts) / simulated, 1)


def fine_steps(run: Run, preset: Preset, worlds: int = COMPARED, *, tolerance_mm: float = 1e-6) -> list[Trajectory]:
    """Return the first worlds of each scene at time steps of 1 ms: what `error_in_time` compares with."""
    return run(replace(PRESETS[preset], time_step_s=1e-3, tolerance_mm=tolerance_mm), worlds)


def _wire_tip(rollout: Trajectory) -> Float[np.ndarray, "worlds samples 3"]:
    return rollout.tip_position[:, :, 0]


def error_in_time(
    name: str,
    rollouts: Sequence[Trajectory],
    fine: Sequence[Trajectory],
    tip: Callable[[Trajectory], Float[np.ndarray, "worlds samples 3"]] = _wire_tip,
) -> dict[str, float]:
    """Return the `spread` of a tip's distance from where it is at fine steps, mm.

    Args:
        name: of the figures.
        rollouts: of all worlds.
        fine: of the first of them, by `fine_steps`.
        tip: takes the tip's positions from a rollout.
    """
    errors = []
    for coarse, exact in zip(rollouts, fine, strict=True):
        both = exact.valid & coarse.valid[: len(exact.valid)]
        errors.append(np.linalg.norm(tip(exact) - tip(coarse)[: len(exact.valid)], axis=-1)[both])
    return spread(name, np.concatenate(errors))
