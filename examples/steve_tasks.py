"""Tasks of stEVE_bench (Karstensen et al., arXiv 2410.01956; MIT) as tasks of the ladder.

    python examples/steve_tasks.py EPISODES.npz steve
    endopilot ladder --version steve --policy agent

    python examples/steve_tasks.py CURVES dual [SEED]
    endopilot ladder --version dual --policy agent

EPISODES.npz holds episodes of ArchVariety: for each seed SSS of the benchmark, what its own generator draws, in mm:
`SSS_branch_NAME` (a row x, y, z, radius for each point), `SSS_insertion_mm`, `SSS_direction` and `SSS_target_mm`. The
folder gets an anatomy for each seed, the benchmark's wire, the task, and a world in which the ostium lies elsewhere.

CURVES is the folder of DualDeviceNav's centerline curves, as 3D Slicer wrote them. The folder gets one anatomy, the
benchmark's wire and catheter, and a task with twenty targets: points of the carotid and vertebral arteries' curves that
lie in no other curve's tube, drawn with SEED (0 if not given).

The benchmark counts a target as reached when the tip is within 5 mm of it; it gives 1000 steps of 1/7.5 s. It has no
limits of force: those are here the ones of a shipped wire, less for DualDeviceNav's, and 0.7 N on a node of the wall.
Without arguments, a made-up arch is converted.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import numpy as np
import yaml

import endopilot
from endopilot.anatomy.catheter_axis import with_axis
from endopilot.tasks.task import list_tasks
from endopilot.vessels.sources import Polylines, read_source

POISSON = 0.49
TIP_RADIUS_MM, TIP_DEG = 12.1, 72.0
"""The tip's bend, of all its devices."""
TIP_MM = round(float(TIP_RADIUS_MM * np.radians(TIP_DEG)), 2)
SOFT_N, SOFT_N_MM = 0.01, 0.01
"""Limits of the drives of DualDeviceNav's devices, N and N·mm: in a loop of 2 mm radius they bear EI/r² = 0.003 N.
Walls are the stiffer the more drives may push: with a hospital's 0.5 N, a micrometre of rounding would press harder."""
TASK = {
    "level": 1,
    "tip_bend_deg": TIP_DEG,
    "tip_bend_mm": TIP_MM,
    "start_inserted_length_mm": 2.0,
    "seconds": 1000 / 7.5,
    "force_limit_n": 0.7,
    "near_mm": 5.0,
}
"""What the benchmark's tasks have in common."""
OSTIUM_MM, DIRECTION = (-35.0, 65.0, 5.0), (-1.0, -1.0, 0.0)
"""Insertion of DualDeviceNav in the coordinates of its curves: the benchmark takes (x, y, z) as (y, -z, -x)."""
NARROW_MM = 0.9
"""Curves with a smaller radius are left out, two branches behind the left carotid artery: the catheter hardly fits into
them, and all walls would have to be five times finer for them."""
GOALS = ("LCCA", "LVA", "RCCA", "RVA")
TARGETS = 20


def device(
    name: str, source: str, diameter_mm: tuple[float, float], modulus_mpa: tuple[float, float], bore_mm: float = 0.0
) -> dict[str, object]:
    """Return a device of the benchmark as the content of its file.

    Args:
        name: of the device.
        source: where its numbers come from.
        diameter_mm: outer diameters of tip and shaft, mm.
        modulus_mpa: Young's moduli of tip and shaft, MPa: the benchmark's files give kPa, which follow from their
            densities (kg, mm, s).
        bore_mm: inner diameter of a catheter, mm. The benchmark's simulator is not given it: there, catheters bend as
            if they were solid.
    """
    micro = bool(bore_mm) or diameter_mm[1] < 0.5
    newtons, torque = (SOFT_N, SOFT_N_MM) if micro else (2.0, 10.0)
    limit = f"{'more than it bears' if micro else 'as shipped j-035'}: the benchmark has no such limit"
    sections = [np.pi * d**4 / 64 for d in diameter_mm]
    tip, shaft = (round(float(e * i), 5) for e, i in zip(modulus_mpa, sections, strict=True))
    bend = [tip, tip, shaft]
    friction = 0.001 if micro else 0.1
    values = {
        "diameter_mm": (diameter_mm[1], f"{source}: of the shaft"),
        "friction": (friction, source),
        "max_velocity_mm_s": (35.0, source),
        "max_rotation_rad_s": (3.14, source),
        "push_limit_n": (newtons, limit),
        "pull_limit_n": (newtons, limit),
        "torque_limit_n_mm": (torque, limit),
        "abscissa_mm": ([0.0, TIP_MM, TIP_MM + 0.5], f"{source}: its tip is bent"),
        "bend_stiffness_n_mm2": (bend, f"{source}: moduli and round sections"),
        "twist_stiffness_n_mm2": ([round(ei / (1 + POISSON), 5) for ei in bend], f"{source}: GJ = EI / (1 + nu)"),
    }
    if bore_mm:
        values |= {"inner_diameter_mm": (bore_mm, source), "bore_friction": (friction, source)}
        shape: dict[str, object] = {"shape": {"arcs": [[TIP_MM, TIP_DEG]], "source": source}}
    else:
        values |= {"tip_load_n": (None, "not stated")}
        shape = {"tip_bend": {"angle_deg": TIP_DEG, "length_mm": TIP_MM, "source": source}}
    return {"name": name} | {key: {"value": value, "source": text} for key, (value, text) in values.items()} | shape


def convert(episodes: Path, folder: Path) -> list[str]:
    """Write anatomies, wire and task of a file of episodes of ArchVariety into a folder, and return the seeds."""
    with np.load(episodes) as content:
        arrays = {name: np.asarray(content[name], dtype=float) for name in content.files}
    seeds = sorted({name.partition("_")[0] for name in arrays if name.endswith("_target_mm")})
    if not seeds:
        raise endopilot.InputError(f"{episodes}: holds no array SSS_target_mm; give episodes of ArchVariety")
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
    wire = device("steve-archvariety", "stEVE_bench, ArchVariety", (0.7, 0.89), (17.0, 80.0))
    task = {
        "name": "archvariety",
        "title": "Aortic arches of stEVE_bench, to an artery above the arch",
        "device": "devices/steve.yaml",
        "ladder": {"seed": 0, "numbers": [int(seed) for seed in seeds]},
        "anatomies": [f"patients/{seed}" for seed in seeds],
        "targets_mm": [arrays[f"{seed}_target_mm"].tolist() for seed in seeds],
    }
    write(folder, {"steve": wire}, task)
    world = {"about": "The ostium lies 3 mm deeper; friction, tip stiffness and latency differ by 20 %, as drawn."}
    (folder / "worlds").mkdir(exist_ok=True)
    (folder / "worlds" / "ostium-off.yaml").write_text(yaml.safe_dump(world | {"ostium_mm": 3.0, "share": 0.2}))
    return seeds


def convert_curves(curves: Path, folder: Path, seed: int = 0) -> list[list[float]]:
    """Write anatomy, devices and task of DualDeviceNav's curves into a folder, and return the targets, LPS mm."""
    lines = read_source(curves).content
    assert isinstance(lines, Polylines)
    kept = [number for number, radius in enumerate(lines.radius) if radius.min() > NARROW_MM]
    lines = Polylines(
        tuple(lines.points[number] for number in kept),
        tuple(lines.radius[number] for number in kept),
        tuple(lines.names[number] for number in kept),
    )
    anatomy = endopilot.extract_anatomy(
        lines, name="dualdevicenav", config=endopilot.AnatomyConfig(ostium_mm=OSTIUM_MM)
    )
    anatomy = with_axis(anatomy, np.array(DIRECTION) / np.linalg.norm(DIRECTION))
    endopilot.write_anatomy(anatomy, output=folder / "patients" / "dualdevicenav")
    free = []
    for own, points in enumerate(lines.points):
        if lines.names[own].split()[-1] not in GOALS:
            continue
        others = [
            np.linalg.norm(points[:, None] - line, axis=2) - lines.radius[other]
            for other, line in enumerate(lines.points)
            if other != own
        ]
        free.append(points[np.min([gap.min(axis=1) for gap in others], axis=0) > 0])
    chosen = np.concatenate(free)
    targets = chosen[np.random.default_rng(seed).choice(len(chosen), TARGETS, replace=False)].tolist()
    source = "stEVE_bench, DualDeviceNav"
    devices = {
        "wire": device("steve-microwire", source, (0.36, 0.36), (1.0, 1.0)),
        "catheter": device("steve-microcatheter", source, (0.6, 0.7), (1.0, 1.0), bore_mm=0.57),
    }
    task = {
        "name": "dualdevicenav",
        "title": "From the iliac artery to carotid and vertebral arteries of stEVE_bench, by wire and catheter",
        "device": "devices/wire.yaml",
        "catheter": "devices/catheter.yaml",
        "ladder": {"seed": seed, "numbers": list(range(TARGETS))},
        "anatomies": TARGETS * ["patients/dualdevicenav"],
        "targets_mm": targets,
    }
    write(folder, devices, task)
    return targets


def write(folder: Path, devices: dict[str, dict[str, object]], task: dict[str, object]) -> None:
    """Write devices and a task into a folder."""
    (folder / "devices").mkdir(parents=True, exist_ok=True)
    for name, content in devices.items():
        (folder / "devices" / f"{name}.yaml").write_text(yaml.safe_dump(content, sort_keys=False))
    (folder / f"{task['name']}.yaml").write_text(yaml.safe_dump(TASK | task, sort_keys=False))


def made_up(path: Path) -> None:
    """Write a file of ArchVariety's form: a straight aorta, and an artery that leaves it."""
    aorta = np.column_stack([np.zeros((61, 2)), np.linspace(0, 120, 61), np.full(61, 8.0)])
    along = np.linspace(0, 60, 31)
    artery = np.column_stack([0.8 * along, np.zeros(31), 50 + 0.6 * along, np.full(31, 4.0)])
    place = {"insertion_mm": aorta[1, :3], "direction": np.array([0.0, 0, 1]), "target_mm": artery[20, :3]}
    lines = {"branch_aorta": aorta, "branch_artery": artery}
    np.savez(path, allow_pickle=False, **{f"001_{name}": value for name, value in (lines | place).items()})


def main() -> None:
    given = sys.argv[1:]
    if not given:
        convert_made_up()
        return
    try:
        if len(given) not in (2, 3) or not all(seed.isdecimal() for seed in given[2:]):
            raise endopilot.InputError("usage: steve_tasks.py EPISODES.npz|CURVES FOLDER [SEED]")
        source, folder = Path(given[0]), Path(given[1])
        curves = source.is_dir()
        if not curves and not (source.is_file() and source.suffix == ".npz"):
            raise endopilot.InputError(f"{source}: is no file of episodes (.npz) and no folder of curves")
        made = convert_curves(source, folder, *map(int, given[2:])) if curves else convert(source, folder)
    except (endopilot.InputError, OSError) as error:
        print(f"steve_tasks.py: {error}", file=sys.stderr)
        sys.exit(2)
    print(f"{len(made)} {'targets' if curves else 'episodes'}")


def convert_made_up() -> None:
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
