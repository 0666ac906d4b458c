"""The Kirchhoff rod of the world `other-engine`: its forces against closed forms, and how it fares in vessels.

`python -m benchmarks engine -o FOLDER` drives wires at random in the patients of `python -m benchmarks worlds`.
"""

from __future__ import annotations

import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from jaxtyping import Float

from benchmarks.agent.worlds import PLACES, Set, navigation_at
from benchmarks.figures import Bar, judged
from benchmarks.verification.contact import LEAD_MM, TUBE_RADIUS_MM, WIRE_RADIUS_MM, bent_tube
from benchmarks.verification.tube import straight_tube
from endopilot.anatomy.distance import sample
from endopilot.devices.device import Wire, read_wire
from endopilot.files import read_json, write_json
from endopilot.navigation.loop import start_world
from endopilot.runs import OutputFolder, claim, make_missing
from endopilot.settings import Within
from endopilot.simulation.controls import ControlConfig, random_controls
from endopilot.simulation.kirchhoff_rod import NODE_MM, KirchhoffRod, PointWall
from endopilot.simulation.world import read_world
from endopilot.tasks.task import CORE
from endopilot.types import SAMPLE_PERIOD_S, DistanceMap
from endopilot.verification.free_rod import Case, Curve, Picture, compare

BEND_N_MM2, BEND_RADIUS_MM = 10.0, 15.0
OUTSIDE_MM = 0.2
"""How far a wire's surface may reach outside the vessel, mm: half a voxel of a patient's distance map."""
TURNS = 4
"""Navigations in each patient."""
BARS = {
    "valid_share": Bar(0.98, at_least=True),
    "outside_mm": Bar(OUTSIDE_MM),
    "core_seconds_a_second": Bar(10.0),
}


def _rod(field: DistanceMap, start_mm: Float[np.ndarray, "3"], bend_n_mm2: float, length_mm: float) -> KirchhoffRod:
    """Return a straight uniform rod that enters a tube along x."""
    stiffness = {"bend_stiffness_n_mm2": (bend_n_mm2,), "twist_stiffness_n_mm2": (bend_n_mm2,)}
    straight = {"tip_bend_rad": 0.0, "tip_bend_length_mm": 0.0, "tip_load_n": None}
    given, profile = read_wire("workhorse-014"), {"abscissa_mm": (0.0,), "diameter_mm": 2 * WIRE_RADIUS_MM}
    wire: Wire = replace(given, **profile, **stiffness, **straight)
    along_x = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    return KirchhoffRod(PointWall(field), start_mm, along_x, wire, length_mm)


def pushed_into_a_bend() -> list[Case]:
    """Compare the push on a rod without friction in a bend, mean over 40° of it, with EI/(2 (R + c)²).

    A further mm of rod takes up this energy of bending, for behind its tip the rod lies on the outer wall, c from the
    axis. The tip's own bend stays as it is as the tip moves on.
    """
    field = bent_tube(0.65 * np.pi, radius_mm=TUBE_RADIUS_MM, bend_radius_mm=BEND_RADIUS_MM, lead_mm=LEAD_MM)
    rod = _rod(field, np.array([-LEAD_MM, 0.0, 0.0]), BEND_N_MM2, 80.0)
    rod.reset(0.0, friction=0.0)
    rod.drive((20.0, 0.0), (LEAD_MM + 15.0) / 20.0)
    pushes = []
    for _ in range(20):
        rod.drive((4.0, 0.0), 0.125)
        pushes.append(rod.load[0])
    expected = BEND_N_MM2 / (2 * (BEND_RADIUS_MM + TUBE_RADIUS_MM - WIRE_RADIUS_MM) ** 2)
    further = 0.5 * np.arange(1, 21)
    curves = (
        Curve("EI/(2 (R + c)²)", further[[0, -1]], np.full(2, expected), "reference"),
        Curve("Kirchhoff rod", further, np.array(pushes)),
    )
    picture = Picture("pushed on, mm", "push, N", curves)
    return [compare("Kirchhoff rod pushed into a bend, N", expected, float(np.mean(pushes)), 0.15, picture)]


def capstan() -> list[Case]:
    """Pull a string around a bend of 90° against a dead load: T2/T1 = exp(µ θ), as `contact.capstan` does."""
    angle, friction, load = np.pi / 2, 0.4, 0.1
    field = bent_tube(angle, radius_mm=TUBE_RADIUS_MM, bend_radius_mm=BEND_RADIUS_MM, lead_mm=LEAD_MM)
    length, out = 1.7 * LEAD_MM + BEND_RADIUS_MM * angle, np.array([0.0, 1.0, 0.0])
    rod = _rod(field, np.array([-LEAD_MM, 0.0, 0.0]), 0.1, length + 5.0)
    rod.reset(0.0, friction=friction)
    rod.tip_force_n = load * out
    rod.drive((20.0, 0.0), length / 20.0)
    ratio = []
    for _ in range(5):
        rod.drive((-0.5, 0.0), 0.5)
        ratio.append(-rod.load[0] / load)
    x = rod.position[:, 0]
    entry = rod.position[np.argmin(np.abs(x + 0.4 * LEAD_MM))] - rod.position[np.argmin(np.abs(x + LEAD_MM))]
    expected = float(np.exp(friction * np.arccos(entry @ out / np.linalg.norm(entry))))
    pulled = 0.5 * np.arange(1, 6)
    curves = (
        Curve("exp(µθ)", pulled[[0, -1]], np.full(2, expected), "reference"),
        Curve("Kirchhoff rod", pulled, np.array(ratio)),
    )
    picture = Picture("time, s", "pull at the base / load on the tip", curves)
    return [compare("Kirchhoff rod, capstan T2/T1", expected, ratio[-1], 0.05, picture)]


def helix_in_a_tube() -> list[Case]:
    """Compare the wall's force on a rod that coils up in a straight tube under a load F on its tip with F² r/(4 EI).

    A. Lubinski, W. S. Althouse and J. L. Logan, J. Petroleum Technology 14 (1962) 655-670: per length, in a helix whose
    slope, r √(F/(2 EI)), is small (here 0.22).
    """
    length, clearance, load = 150.0, 1.0, 1.0
    field = straight_tube(length_mm=length + 20.0, radius_mm=clearance + WIRE_RADIUS_MM)
    rod = _rod(field, np.array([8.0, 0.0, 0.0]), BEND_N_MM2, length + 10.0)
    rod.reset(0.0, friction=0.0, inserted_mm=length)
    rod.tip_force_n = np.array([-load, 1e-3, 5e-4])  # no rod is pressed on along its very axis
    times, forces = np.arange(1.0, 4.0), []
    middle = (rod.abscissa_mm > 40.0) & (rod.abscissa_mm < 110.0)
    for _ in times:
        rod.drive((0.0, 0.0), 1.0)
        forces.append(rod.pressed[middle].mean() / NODE_MM)
    expected = load**2 * clearance / (4 * BEND_N_MM2)
    curves = (
        Curve("F² r/(4 EI)", times[[0, -1]], np.full(2, expected), "reference"),
        Curve("Kirchhoff rod", times, np.array(forces)),
    )
    picture = Picture("time, s", "wall's force, N/mm", curves)
    return [compare("Kirchhoff rod coiled up in a tube, wall's force, N/mm", expected, forces[-1], 0.1, picture)]


def drive_engine(
    *,
    output: OutputFolder,
    seconds: Annotated[float, Within(1, 600)] = 15.0,
    patients: Set = "test",
    places: Annotated[int, Within(1, PLACES)] = 28,
) -> dict[str, Any]:
    """Drive wires of the world other-engine at random, four in each patient: are they valid, how fast, how pressed.

    `output` gets one file a patient; an interrupted run goes on with the others.

    Args:
        output: folder of the results.
        seconds: length of each navigation, s.
        patients: set of the patients.
        places: how many of them.

    Returns:
        Navigations, the share that stayed valid (no node farther outside the vessel than its wire's radius and 0.2 mm,
        all finite), the farthest that a wire's surface lay outside, mm, seconds of a core a simulated second, and the
        wall's force on 2 mm of wire: median and largest, N.

    Raises:
        InputError: the folder belongs to another run.
    """
    claim(output, "python -m benchmarks engine", seconds=seconds, patients=patients)
    paths = [output / f"{place:02d}.json" for place in range(places)]
    make_missing("Wires of another engine", paths, partial(_drive, seconds=seconds, patients=patients))
    driven = [each for path in paths for each in read_json(path)]
    walls = np.concatenate([each["wall_n"] for each in driven])
    inside = [each["valid"] and each["outside_mm"] <= OUTSIDE_MM for each in driven]
    figures = {
        "navigations": len(driven),
        "valid_share": float(np.mean(inside)),
        "outside_mm": max(each["outside_mm"] for each in driven),
        "core_seconds_a_second": sum(each["core_s"] for each in driven) / sum(each["seconds"] for each in driven),
        "wall_median_n": float(np.median(walls)),
        "wall_largest_n": float(walls.max()),
    }
    return judged({name: round(value, 4) for name, value in figures.items()}, BARS)


def _drive(path: Path, seconds: float, patients: Set) -> None:
    """Drive a wire in one patient some times, and write how it fared."""
    place, found = int(path.stem), []
    _, navigation, seed = navigation_at(patients, place)
    simulator = start_world(navigation, read_world("other-engine"), replace(CORE, threads=1))
    config = ControlConfig(first_inserted_length_mm=navigation.start_inserted_length_mm)
    initial, control = random_controls(
        config,
        n_sequences=TURNS,
        n_samples=round(seconds / SAMPLE_PERIOD_S),
        seed=seed,
        max_inserted_length_mm=float(navigation.anatomy.tree.longest_path().abscissa[-1]),
    )
    for start, velocities in zip(initial.reshape(TURNS, 2), control[:, :, 0], strict=True):
        simulator.reset(inserted_length=start[:1], rotation=start[1:])
        began, wall, outside = time.process_time(), [], []
        for velocity in velocities:
            step = simulator.step(velocity[None], SAMPLE_PERIOD_S)
            ahead = simulator.position[0, : int(simulator.active_nodes[0]) - 1]
            wall.append(float(step.wall_force[0]))
            outside.append(navigation.device.tip_radius_mm - sample(navigation.anatomy.distance_map, ahead).min())
        found.append(
            {
                "valid": bool(simulator.valid[0]),
                "outside_mm": float(max(outside)),
                "wall_n": wall,
                "core_s": time.process_time() - began,
                "seconds": SAMPLE_PERIOD_S * len(velocities),
            }
        )
    write_json(path, found)


CASES = (pushed_into_a_bend, capstan, helix_in_a_tube)
