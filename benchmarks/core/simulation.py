"""Speed of the rod core and its error against a converged solution, measured together on the same worlds."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np

from benchmarks.core.beside import bench_motion, effort, error_in_time, fine_steps, run_all
from benchmarks.core.coaxial import bench_coaxial
from benchmarks.core.errors import error_figures, error_intervals
from benchmarks.core.gpu import bench_gpu
from benchmarks.core.reference import REFERENCE_FILE, check_reference, read_reference
from benchmarks.core.reference import make_reference as make
from benchmarks.core.scenes import DEVICE, Solution, make_scenes, simulated_s
from benchmarks.figures import in_turns, timed
from endopilot.atlas.atlas import AtlasConfig, make_patient
from endopilot.devices.catheter import read_catheter
from endopilot.devices.device import read_wire
from endopilot.errors import InputError
from endopilot.simulation.config import PRESETS, Preset, SimulatorConfig, wall_stiffness
from endopilot.simulation.motion import MotionName, motion_named
from endopilot.simulation.simulator import Simulator

COMPARED = 8
"""Worlds of each scene that the error in time alone is measured on."""
MANY = 4
"""Times as many worlds for the speedup of two threads: the reference's own leave a third of their lanes idle."""


def bench_simulation(
    *,
    preset: Preset = "default",
    catheter: str | None = None,
    motion: MotionName = "still",
    device: Literal["cpu", "cuda"] = "cpu",
    make_reference: bool = False,
    reference: Path = REFERENCE_FILE,
) -> dict[str, Any] | list[dict[str, Any]]:
    """Measure the speed of the rod core, and the tip's error at that speed against a converged solution.

    Args:
        preset: settings of the rod core: default, fast or accurate.
        catheter: measure the wire in this catheter (a name or a YAML file), beside the wire alone.
        motion: measure the wire in patients that move (breathing, heartbeat or both), beside the same at rest.
        device: measure the processor (cpu), or up to 100 000 wires on a GPU (cuda) and how closely the two agree.
        make_reference: compute the converged solution anew instead, which takes a quarter of an hour.
        reference: file of the converged solution.

    Returns:
        The figures of `against_reference`, or those of `bench_coaxial`, `bench_motion` or `bench_gpu`.

    Raises:
        InputError: the reference is missing or is that of other scenes; both a catheter and a motion are given; the
            catheter does not fit; there is no GPU.
    """
    moves = motion_named(motion)
    if catheter is not None and moves is not None:
        raise InputError("motion: with a catheter; measure one of the two")
    if catheter is not None:
        return bench_coaxial(read_catheter(catheter), preset)
    if moves is not None:
        return {"motion": motion, **bench_motion(moves, preset)}
    if device == "cuda":
        return bench_gpu(preset)
    return dict(make(reference)) if make_reference else against_reference(preset, reference)


def against_reference(preset: Preset = "default", reference: Path = REFERENCE_FILE) -> dict[str, Any]:
    """Measure the rod core on the reference's scenes: random navigations of 60 s in three synthetic patients.

    Args:
        preset: name of the settings.
        reference: file of the converged solution.

    Returns:
        `realtime_factor_per_core` (simulated seconds per second of processor time on one thread, including everything
        that `simulate` does), `node_iterations_per_second` (evaluations of nodes a simulated second, all steps and
        attempts), `threads_speedup` (two threads against one, with `MANY` times as many worlds) and
        `threads_speedup_few_worlds` (with the reference's worlds); the errors of `error_figures`, their `intervals`
        over worlds and the figures `by_anatomy`; `tip_error_*`, the error in time alone: against the same elements at
        1 ms and 1e-8 mm; the iterations a time step, the share of valid worlds, the largest wall forces, and
        `seconds_for_first_call`: of one world and sample, the first call after the imports. `reference_own_error` holds
        the reference's figures against a finer solution.

    Raises:
        InputError: the reference is missing or is that of other scenes.
    """
    exact = read_reference(reference)
    scenes = make_scenes(exact.recipe["worlds"], exact.recipe["samples"])
    check_reference(reference, scenes)
    config = replace(PRESETS[preset], threads=1)
    first_call = timed(lambda: scenes[0].run(config, 1))[1]
    (rollouts, alone, processor), (_, together, _) = in_turns(
        lambda: run_all(scenes, config), lambda: run_all(scenes, replace(config, threads=2))
    )
    found = Solution.of(scenes, rollouts)
    owner = np.repeat(np.arange(len(scenes)), [len(scene.control) for scene in scenes])
    force = np.percentile(found.contact_force_max[found.valid], 99.9)
    fine = fine_steps(partial(run_all, scenes), preset, COMPARED, tolerance_mm=1e-8)
    return {
        "preset": preset,
        "realtime_factor_per_core": round(simulated_s(scenes) / processor, 1),
        "threads_speedup": round(_threads_speedup(exact.recipe, config), 3),
        "threads_speedup_few_worlds": round(alone / together, 3),
        **error_figures(found, exact.solution),
        **error_in_time("tip_error", rollouts, fine),
        **effort(rollouts),
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


def _threads_speedup(recipe: Mapping[str, Any], config: SimulatorConfig) -> float:
    scenes = make_scenes(MANY * recipe["worlds"], recipe["samples"])
    alone, together = (timed(partial(run_all, scenes, replace(config, threads=threads)))[1] for threads in (1, 2))
    return alone / together


def bench_scaling() -> list[dict[str, Any]]:
    """Measure how cost and memory grow with finer elements and with the number of worlds, on one thread.

    Returns:
        Rows of `element_mm`, `worlds`, `seconds` (processor time of the core), `us_per_node_and_iteration` (of the
        nodes ahead of the catheter) and `kilobytes_per_world` (growth of the process's memory; the map is shared).
    """
    anatomy, device = make_patient(AtlasConfig(population="textbook"), 0), read_wire(DEVICE)
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
