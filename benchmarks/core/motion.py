"""Speed of the rod core where the vessel moves, beside that where it lies still, on the same worlds."""

from __future__ import annotations

from typing import Any

from benchmarks.core.beside import bench_beside, error_in_time, fine_steps
from benchmarks.core.scenes import SAMPLES, WORLDS, make_scenes
from endopilot.simulation.config import Preset, SimulatorConfig
from endopilot.simulation.motion import Motion
from endopilot.types import Rollout

LEAST_SHARE = 0.5
"""Of the real-time factor in a still vessel, that in a moving one must reach."""


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

    def run(config: SimulatorConfig, worlds: int | None) -> list[Rollout]:
        return [scene.run(config, worlds, motion=motion) for scene in scenes]

    figures, rollouts = bench_beside(run, scenes, preset, beside="still", least_share=LEAST_SHARE)
    error = error_in_time("tip_error", rollouts, fine_steps(run, preset), lambda rollout: rollout.tip_position)
    return figures | error
