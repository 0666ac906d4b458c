"""Speed of the rod core with a catheter around the wire, beside that of the wire alone on the same worlds."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from endopilot.benchmarks.scenes import SAMPLES, SEED, WORLDS, Scene, make_scenes
from endopilot.simulation.catheter import Catheter
from endopilot.simulation.config import PRESETS, Preset, SimulatorConfig
from endopilot.simulation.controls import ControlConfig, random_controls
from endopilot.simulation.simulate import simulate
from endopilot.types import SAMPLE_PERIOD_S, Rollout

LEAST_SHARE = 1 / 3
"""Of the real-time factor of a wire alone, that wire and catheter must reach."""
COMPARED = 2
"""Worlds of each scene that the error in time is measured on."""
REPEATS = 3
"""Times that the worlds are simulated for the timing; the fastest counts."""


def bench_coaxial(
    catheter: Catheter, preset: Preset = "default", *, worlds: int = WORLDS, samples: int = SAMPLES
) -> dict[str, Any]:
    """Drive wire and catheter at random through three synthetic patients, each by a drive of its own.

    Args:
        catheter: the catheter around the reference's wire.
        preset: name of the settings.
        worlds: of each patient.
        samples: of each world.

    Returns:
        `realtime_factor_per_core` (simulated seconds per second of processor time on one thread) of wire and catheter,
        that of the wire alone on the same worlds, and `share`, the first over the second, with its `bar` and whether it
        `passed`; the share of valid worlds, the iterations a time step, the largest wall force, and the error in time
        of both tips: against a time step of 1 ms, on a few of the worlds.

    Raises:
        InputError: the catheter does not fit the wire or a patient.
    """
    scenes, config = make_scenes(worlds, samples), replace(PRESETS[preset], threads=1)
    starts, controls = zip(*(_catheter_drive(scene, place) for place, scene in enumerate(scenes)), strict=True)
    simulated = SAMPLE_PERIOD_S * sum(scene.control.shape[0] * scene.control.shape[1] for scene in scenes)

    def run(config: SimulatorConfig, count: int | None = None) -> list[Rollout]:
        return [
            simulate(
                scene.anatomy,
                scene.device,
                np.concatenate([scene.control, control], axis=-1)[:count],
                catheters=[catheter],
                initial=np.concatenate([scene.initial, start], axis=-1)[:count],
                config=config,
            )
            for scene, start, control in zip(scenes, starts, controls, strict=True)
        ]

    alone, both = [], []
    rollouts: list[Rollout] = []
    for _ in range(REPEATS):
        begun = time.process_time()
        for scene in scenes:
            scene.run(config)
        alone.append(time.process_time() - begun)
        begun = time.process_time()
        rollouts = run(config)
        both.append(time.process_time() - begun)
    share = min(alone) / min(both)
    return {
        "catheter": catheter.name,
        "preset": preset,
        "realtime_factor_per_core": round(simulated / min(both), 1),
        "wire_alone_realtime_factor_per_core": round(simulated / min(alone), 1),
        "share": round(share, 3),
        "bar": round(LEAST_SHARE, 3),
        "passed": share >= LEAST_SHARE,
        "valid_worlds": round(float(np.mean([rollout.valid[:, -1].mean() for rollout in rollouts])), 5),
        "iterations_per_step": round(float(np.mean([r.iterations[r.valid].mean() for r in rollouts])), 3),
        "largest_wall_force_n": round(max(float(r.wall_force[r.valid].max()) for r in rollouts), 4),
        **_error_in_time(rollouts, run(replace(config, time_step_s=1e-3, tolerance_mm=1e-6, threads=0), COMPARED)),
        "worlds": sum(len(scene.control) for scene in scenes),
    }


def _catheter_drive(scene: Scene, place: int) -> tuple[np.ndarray, np.ndarray]:
    """Return random starts and controls of the catheter in a scene."""
    worlds, samples = scene.control.shape[:2]
    return random_controls(
        ControlConfig(),
        n_sequences=worlds,
        n_samples=samples,
        seed=SEED,
        max_inserted_length_mm=float(scene.anatomy.tree.longest_path().abscissa[-1]),
        first=2**32 + place * worlds,
    )


def _error_in_time(rollouts: Sequence[Rollout], fine: Sequence[Rollout]) -> dict[str, float]:
    errors: dict[str, list[np.ndarray]] = {"wire": [], "catheter": []}
    for coarse, exact in zip(rollouts, fine, strict=True):
        count = len(exact.valid)
        valid = exact.valid & coarse.valid[:count]
        errors["wire"].append(np.linalg.norm(exact.tip_position - coarse.tip_position[:count], axis=-1)[valid])
        if exact.catheters is not None and coarse.catheters is not None:
            off = exact.catheters.tip_position - coarse.catheters.tip_position[:count]
            errors["catheter"].append(np.linalg.norm(off[:, :, 0], axis=-1)[valid])
    return {
        f"{name}_tip_error_{figure}_mm": round(float(np.percentile(np.concatenate(parts), percent)), 5)
        for name, parts in errors.items()
        for figure, percent in (("median", 50), ("p95", 95))
    }
