"""Speed of the rod core and its error against a converged solution, measured together on the same worlds."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from endopilot.atlas.atlas import AtlasConfig, make_patient
from endopilot.benchmarks.baseline import BASELINE_FOLDER, Baseline
from endopilot.benchmarks.beside import node_iterations_per_second
from endopilot.benchmarks.errors import error_figures, error_intervals
from endopilot.benchmarks.reference import REFERENCE_FILE, check_reference, read_reference
from endopilot.benchmarks.scenes import DEVICE, KINDS, SEED, Scene, Solution, make_scenes
from endopilot.devices.device import read_device
from endopilot.simulation.config import PRESETS, Preset, SimulatorConfig, wall_stiffness
from endopilot.simulation.simulator import Simulator
from endopilot.types import SAMPLE_PERIOD_S, Rollout

COMPARED = 8
"""Worlds of each scene that the error in time alone is measured on."""
REPEATS = 3
"""Times that the worlds are simulated for the timing; the fastest counts."""
MANY = 4
"""Times as many worlds for the speedup of two threads: the reference's own leave a third of their lanes idle."""


def bench_simulation(
    preset: Preset = "default", *, reference: Path = REFERENCE_FILE, baseline: Path = BASELINE_FOLDER
) -> dict[str, Any]:
    """Measure the rod core on the reference's scenes: random navigations of 60 s in three synthetic patients.

    Args:
        preset: name of the settings.
        reference: file of the converged solution.
        baseline: folder of the older build that the speed is compared with.

    Returns:
        `realtime_factor_per_core` (simulated seconds per second of processor time on one thread, including everything
        that `simulate` does), `speed_over_baseline` (the same against the older build with its default settings, in
        turns with it; None where there is no such build), `node_iterations_per_second` (evaluations of nodes a
        simulated second, all steps and attempts), `threads_speedup` (two threads against one, with `MANY` times as
        many worlds) and `threads_speedup_few_worlds` (with the reference's worlds); the errors of
        `error_figures`, their `intervals` over worlds and the figures `by_anatomy`; `tip_error_*`, the error in time
        alone: against the same elements at 1 ms and 1e-8 mm; the iterations a time step, the share of valid worlds, the
        largest wall forces, and `seconds_for_first_call`: of one world and sample, the first call after the imports.
        `reference_own_error` holds the reference's figures against a finer solution.

    Raises:
        InputError: the reference is missing or is that of other scenes; the older build does not run.
    """
    exact = read_reference(reference)
    scenes = make_scenes(exact.recipe["worlds"], exact.recipe["samples"])
    check_reference(reference, scenes)
    config = replace(PRESETS[preset], threads=1)
    started = time.perf_counter()
    scenes[0].run(config, 1)
    first_call = time.perf_counter() - started
    timed = _time(scenes, config, baseline)
    found = Solution.of(scenes, timed.rollouts)
    owner = np.repeat(np.arange(len(scenes)), [len(scene.control) for scene in scenes])
    simulated = SAMPLE_PERIOD_S * sum(scene.control.shape[0] * scene.control.shape[1] for scene in scenes)
    force = np.percentile(found.contact_force_max[found.valid], 99.9)
    return {
        "preset": preset,
        "realtime_factor_per_core": round(simulated / timed.processor, 1),
        "speed_over_baseline": None if timed.baseline is None else round(timed.baseline / timed.processor, 3),
        "node_iterations_per_second": node_iterations_per_second(timed.rollouts),
        "threads_speedup": round(_threads_speedup(exact.recipe, config), 3),
        "threads_speedup_few_worlds": round(timed.alone / timed.together, 3),
        **error_figures(found, exact.solution),
        **_error_in_time(scenes, config, timed.rollouts),
        "iterations_per_step": round(float(np.mean([r.iterations[r.valid].mean() for r in timed.rollouts])), 3),
        "valid_worlds": round(float(found.valid[:, -1].mean()), 5),
        "contact_force_p999_n": round(float(force), 4),
        "penetration_p999_mm": round(float(force) / wall_stiffness(config, scenes[0].device.push_limit_n), 4),
        "seconds_for_first_call": round(first_call, 3),
        "worlds": len(owner),
        "intervals": error_intervals(found, exact.solution, owner),
        "by_anatomy": {
            scene.name: error_figures(found.worlds(rows), exact.solution.worlds(rows))
            for scene, rows in ((scene, np.flatnonzero(owner == place)) for place, scene in enumerate(scenes))
        },
        "reference_own_error": exact.recipe["own_error"],
    }


@dataclass(frozen=True, eq=False)
class _Timed:
    """The scenes' rollouts; processor time, and that of the older build, s; wall time on one and two threads, s."""

    rollouts: list[Rollout]
    processor: float
    baseline: float | None
    alone: float
    together: float


def _time(scenes: Sequence[Scene], config: SimulatorConfig, baseline: Path) -> _Timed:
    work = {
        "kinds": list(KINDS.values()),
        "seed": SEED,
        "device": DEVICE,
        "worlds": len(scenes[0].control),
        "samples": scenes[0].control.shape[1],
    }
    older = Baseline(baseline, work) if baseline.exists() else None
    then, alone, together, processor = [], [], [], []
    rollouts: list[Rollout] = []
    try:
        for _ in range(REPEATS):
            if older is not None:
                then.append(older.seconds())
            rollouts, wall, spent = _run(scenes, config)
            alone.append(wall)
            processor.append(spent)
            together.append(_run(scenes, replace(config, threads=2))[1])
    finally:
        if older is not None:
            older.close()
    return _Timed(rollouts, min(processor), min(then, default=None), min(alone), min(together))


def _run(scenes: Sequence[Scene], config: SimulatorConfig) -> tuple[list[Rollout], float, float]:
    wall, processor = time.perf_counter(), time.process_time()
    rollouts = [scene.run(config) for scene in scenes]
    return rollouts, time.perf_counter() - wall, time.process_time() - processor


def _threads_speedup(recipe: Mapping[str, Any], config: SimulatorConfig) -> float:
    scenes = make_scenes(MANY * recipe["worlds"], recipe["samples"])
    alone, together = (_run(scenes, replace(config, threads=threads))[1] for threads in (1, 2))
    return alone / together


def _error_in_time(scenes: Sequence[Scene], config: SimulatorConfig, rollouts: Sequence[Rollout]) -> dict[str, float]:
    errors = []
    for scene, rollout in zip(scenes, rollouts, strict=True):
        fine = scene.run(replace(config, time_step_s=1e-3, tolerance_mm=1e-8, threads=0), COMPARED)
        both = fine.valid & rollout.valid[:COMPARED]
        errors.append(np.linalg.norm(fine.tip_position - rollout.tip_position[:COMPARED], axis=-1)[both])
    error = np.concatenate(errors)
    return {
        "tip_error_mean_mm": round(float(error.mean()), 5),
        "tip_error_median_mm": round(float(np.median(error)), 5),
        "tip_error_p95_mm": round(float(np.percentile(error, 95)), 5),
        "tip_error_max_mm": round(float(error.max()), 5),
    }


def bench_scaling() -> list[dict[str, Any]]:
    """Measure how cost and memory grow with finer elements and with the number of worlds, on one thread.

    Returns:
        Rows of `element_mm`, `worlds`, `seconds` (processor time of the core), `us_per_node_and_iteration` (of the
        nodes ahead of the catheter) and `kilobytes_per_world` (growth of the process's memory; the map is shared).
    """
    anatomy, device = make_patient(AtlasConfig(population="textbook"), 0), read_device(DEVICE)
    depth = 0.6 * float(anatomy.tree.longest_path().abscissa[-1])
    rows = []
    for element_mm, worlds in (
        *((size, 64) for size in (1.5, 0.75, 0.375, 0.1875)),
        *((0.75, n) for n in (1, 10, 100, 1000, 10_000)),
    ):
        config = SimulatorConfig(element_mm=element_mm, threads=1)
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
                "element_mm": element_mm,
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
