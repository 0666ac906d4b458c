"""The episodes of stEVE_bench's ArchVariety (Karstensen et al., arXiv 2410.01956; MIT) as a task of the ladder.

    python examples/steve_tasks.py EPISODES.npz steve
    endopilot ladder --version steve --policy agent

EPISODES.npz holds, for each seed SSS of the benchmark, what its own generator draws, in mm: `SSS_branch_NAME` (a row
x, y, z, radius for each point), `SSS_insertion_mm`, `SSS_direction` and `SSS_target_mm`. The folder gets an anatomy for
each seed, the benchmark's wire, and the task. The benchmark counts a target as reached when the tip is within 5 mm of
it; it gives 1000 steps of 1/7.5 s. It has no limits of force: those are here the ones of the shipped 0.035-inch wire,
and 0.7 N on a node of the wall. Without arguments, a made-up arch is converted.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import numpy as np
import yaml

import endopilot
from endopilot.anatomy.catheter_axis import with_axis
from endopilot.anatomy.sources import Polylines
from endopilot.tasks.task import list_tasks

SHAFT_MPA, TIP_MPA, POISSON = 80.0, 17.0, 0.49
"""Moduli of the benchmark's wire: its file has 8e4 and 1.7e4 kPa, which follow from its densities (kg, mm, s)."""
SHAFT_MM, TIP_MM = 0.89, 0.7
"""Diameters of shaft and tip."""
TIP_RADIUS_MM, TIP_DEG = 12.1, 72.0
"""The tip's bend."""
SECONDS = 1000 / 7.5


def wire() -> dict[str, object]:
    """Return the benchmark's wire as the content of a device's file."""
    source = "stEVE_bench, ArchVariety"
    length = TIP_RADIUS_MM * np.radians(TIP_DEG)
    bend = [round(float(e * np.pi * d**4 / 64), 4) for e, d in ((TIP_MPA, TIP_MM), (SHAFT_MPA, SHAFT_MM))]
    bend = [bend[0], bend[0], bend[1]]
    values = {
        "diameter_mm": (SHAFT_MM, f"{source}: of the shaft"),
        "friction": (0.1, source),
        "max_velocity_mm_s": (35.0, source),
        "max_rotation_rad_s": (3.14, source),
        "push_limit_n": (2.0, "as j-035: the benchmark has no such limit"),
        "pull_limit_n": (2.0, "as j-035: the benchmark has no such limit"),
        "torque_limit_n_mm": (10.0, "as j-035: the benchmark has no such limit"),
        "abscissa_mm": ([0.0, round(float(length), 2), round(float(length), 2) + 0.5], f"{source}: its tip is bent"),
        "bend_stiffness_n_mm2": (bend, f"{source}: moduli and solid round sections"),
        "twist_stiffness_n_mm2": ([round(ei / (1 + POISSON), 4) for ei in bend], f"{source}: GJ = EI / (1 + nu)"),
        "tip_load_n": (None, "not stated"),
    }
    named = {name: {"value": value, "source": text} for name, (value, text) in values.items()}
    tip = {"angle_deg": TIP_DEG, "length_mm": round(float(length), 2), "source": source}
    return {"name": "steve-archvariety", **named, "tip_bend": tip}


def convert(episodes: Path, folder: Path) -> list[str]:
    """Write anatomies, wire and task of a file of episodes into a folder, and return the seeds."""
    with np.load(episodes) as content:
        arrays = {name: np.asarray(content[name], dtype=float) for name in content.files}
    seeds = sorted({name.partition("_")[0] for name in arrays})
    for seed in seeds:
        lines = {name: line for name, line in arrays.items() if name.startswith(f"{seed}_branch_")}
        source = Polylines(
            tuple(line[:, :3] for line in lines.values()),
            tuple(line[:, 3] for line in lines.values()),
            tuple(name.removeprefix(f"{seed}_branch_") for name in lines),
        )
        insertion = tuple(arrays[f"{seed}_insertion_mm"].tolist())
        anatomy = endopilot.extract_anatomy(
            source, name=f"archvariety-{seed}", config=endopilot.AnatomyConfig(ostium_mm=insertion)
        )
        direction = arrays[f"{seed}_direction"]
        anatomy = with_axis(anatomy, direction / np.linalg.norm(direction))
        endopilot.write_anatomy(anatomy, output=folder / "patients" / seed)
    task = {
        "name": "archvariety",
        "level": 1,
        "title": "Aortic arches of stEVE_bench, to an artery above the arch",
        "device": "devices/steve.yaml",
        "tip_bend_deg": TIP_DEG,
        "tip_bend_mm": round(float(TIP_RADIUS_MM * np.radians(TIP_DEG)), 2),
        "start_inserted_length_mm": 2.0,
        "seconds": SECONDS,
        "force_limit_n": 0.7,
        "ladder": {"seed": 0, "numbers": [int(seed) for seed in seeds]},
        "anatomies": [f"patients/{seed}" for seed in seeds],
        "targets_mm": [arrays[f"{seed}_target_mm"].tolist() for seed in seeds],
        "near_mm": 5.0,
    }
    (folder / "devices").mkdir(parents=True, exist_ok=True)
    (folder / "devices" / "steve.yaml").write_text(yaml.safe_dump(wire(), sort_keys=False))
    (folder / "archvariety.yaml").write_text(yaml.safe_dump(task, sort_keys=False))
    return seeds


def made_up(path: Path) -> None:
    """Write a file of the benchmark's form: a straight aorta, and an artery that leaves it."""
    aorta = np.column_stack([np.zeros((61, 2)), np.linspace(0, 120, 61), np.full(61, 8.0)])
    along = np.linspace(0, 60, 31)
    artery = np.column_stack([0.8 * along, np.zeros(31), 50 + 0.6 * along, np.full(31, 4.0)])
    place = {"insertion_mm": aorta[1, :3], "direction": np.array([0.0, 0, 1]), "target_mm": artery[20, :3]}
    lines = {"branch_aorta": aorta, "branch_artery": artery}
    np.savez(path, allow_pickle=False, **{f"001_{name}": value for name, value in (lines | place).items()})


def main() -> None:
    if len(sys.argv) == 3:
        print(f"{len(convert(Path(sys.argv[1]), Path(sys.argv[2])))} episodes")
        return
    with tempfile.TemporaryDirectory() as folder:
        made_up(Path(folder) / "episodes.npz")
        convert(Path(folder) / "episodes.npz", Path(folder) / "steve")
        (task,) = list_tasks(str(Path(folder) / "steve"))
        navigation = task.ladder_navigation(0)
    place = navigation.target.position(navigation.anatomy)
    print(f"{navigation.anatomy.name}: {navigation.device.name} to {place.round(1).tolist()} mm")
    assert np.allclose(place, [32, 0, 74], atol=0.5)


if __name__ == "__main__":
    main()
