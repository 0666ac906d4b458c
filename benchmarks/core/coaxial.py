"""Speed of the rod core with a catheter around the wire, beside that of the wire alone on the same worlds."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from benchmarks.core.beside import bench_beside, error_in_time, fine_steps, node_iterations_per_second
from benchmarks.core.scenes import SAMPLES, SEED, WORLDS, Scene, make_scenes
from endopilot.devices.catheter import Catheter
from endopilot.devices.device import Device, Wire
from endopilot.devices.stack import Stack
from endopilot.simulation.config import PRESETS, Preset, SimulatorConfig, wall_stiffness
from endopilot.simulation.controls import ControlConfig, random_controls
from endopilot.simulation.simulate import simulate
from endopilot.simulation.trajectory import Trajectory

LEAST_SHARE = 1 / 3
"""Of the real-time factor of a wire alone, that wire and catheter must reach."""


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
        The figures of `bench_beside`; the catheter's name; `catheter_alone_node_iterations_per_second`, of the catheter
        as a single rod without the wire, in the pair's vessels; and the error in time of both tips: against a time step
        of 1 ms, on a few of the worlds.

    Raises:
        InputError: the catheter does not fit the wire or a patient.
    """
    scenes = make_scenes(worlds, samples)
    starts, controls = zip(*(_catheter_drive(scene, place) for place, scene in enumerate(scenes)), strict=True)

    def run(config: SimulatorConfig, worlds: int | None) -> list[Trajectory]:
        return [
            simulate(
                scene.anatomy,
                Stack(scene.device, (catheter,)),
                np.concatenate([scene.control, control], axis=2)[:worlds],
                initial=np.concatenate([scene.initial, start], axis=1)[:worlds],
                config=config,
            )
            for scene, start, control in zip(scenes, starts, controls, strict=True)
        ]

    figures, rollouts = bench_beside(run, scenes, preset, beside="wire_alone", least_share=LEAST_SHARE)
    fine = fine_steps(run, preset)
    pair_wall = wall_stiffness(PRESETS[preset], Stack(scenes[0].device, (catheter,)).push_limit_n)
    config = replace(PRESETS[preset], threads=1, wall_stiffness_n_mm=pair_wall)
    alone = [
        simulate(scene.anatomy, _alone(catheter), control, initial=start, config=config)
        for scene, start, control in zip(scenes, starts, controls, strict=True)
    ]
    return {
        "catheter": catheter.name,
        **figures,
        "catheter_alone_node_iterations_per_second": node_iterations_per_second(alone),
        **error_in_time("wire_tip_error", rollouts, fine),
        **error_in_time("catheter_tip_error", rollouts, fine, _catheter_tip),
    }


def _alone(catheter: Catheter) -> Wire:
    """Return a wire as thick and as stiff as a catheter."""
    common = {each.name: getattr(catheter, each.name) for each in fields(Device)}
    return Wire(**common, tip_bend_rad=0.0, tip_bend_length_mm=0.0, tip_load_n=None)


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


def _catheter_tip(rollout: Trajectory) -> Float[np.ndarray, "worlds samples 3"]:
    return rollout.tip_position[:, :, 1]
