"""Write the tables of docs/evidence/atlas.md and draw its pictures: `python docs/figures/atlas.py`."""

from __future__ import annotations

import sys
import time
from collections import Counter
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np

sys.path.append(str(Path(__file__).parents[2]))  # where `benchmarks` is

from benchmarks.anatomy.labels import measure_labels
from benchmarks.figures import fill
from endopilot.atlas import curves as shape
from endopilot.atlas.atlas import VESSELS, AtlasConfig, make_patient, make_patient_tree
from endopilot.phantom.phantom import PhantomConfig, make_phantom
from endopilot.types import VesselTree

mpl.use("Agg")
import matplotlib.pyplot as plt

PICTURES = Path(__file__).parents[1] / "images"
Patients = list[tuple[VesselTree, dict[str, Any]]]
SHOWN = {"rca": (0, 2), "lca": (0, 2), "cerebral": (0, 2), "portal": (0, 2), "arch": (0, 2)}
"""Axes of the picture: left and up."""


def patients_of(anatomy: str, count: int = 60) -> Patients:
    """Return the textbook's trees of seed 0."""
    config = AtlasConfig(vessel=anatomy, seed=0, population="textbook")
    return [make_patient_tree(config, index) for index in range(count)]


def diameters(patients: Patients, section: str) -> list[float]:
    """Return the mean lumen diameter of a section in each patient that has it, mm."""
    found = []
    for tree, _ in patients:
        number = tree.section_names.index(section)
        radii = [branch.centerline.radius[branch.section == number] for branch in tree.branches]
        if sum(map(len, radii)):
            found.append(2 * float(np.mean(np.concatenate(radii))))
    return found


def origins(patients: Patients, section: str, before: str | None = None) -> list[float]:
    """Return where branches of a section leave: abscissa from the ostium, or from the end of section `before`, mm."""
    found = []
    for tree, _ in patients:
        number = tree.section_names.index(section)
        start = 0.0
        if before is not None:
            own = [
                b.centerline.abscissa[-1] for b in tree.branches if b.section[-1] == tree.section_names.index(before)
            ]
            start = float(max(own))
        found += [b.centerline.abscissa[0] - start for b in tree.branches if np.all(b.section == number)][:1]
    return found


def at_start(patients: Patients, section: str) -> list[float]:
    """Return the lumen's diameter 12 mm behind the origin of a branch, out of its parent's lumen, mm."""
    found = []
    for tree, _ in patients:
        number = tree.section_names.index(section)
        first = next((b for b in tree.branches if np.all(b.section == number)), None)
        if first is not None:
            found.append(2 * float(first.centerline.radius[min(24, len(first.centerline.radius) - 1)]))
    return found


def drawn(patients: Patients, name: str) -> list[float]:
    """Return a figure that each patient's truth holds."""
    return [float(truth[name]) for _, truth in patients]


def line(quantity: str, values: list[float], published: str, digits: int = 1) -> str:
    """Return a row of a table: mean ± SD beside the published figure."""
    return f"| {quantity} | {np.mean(values):.{digits}f} ± {np.std(values, ddof=1):.{digits}f} | {published} |"


def table(rows: list[str]) -> str:
    """Return a table of quantity, atlas, published."""
    return "\n".join(["| quantity | atlas | published |", "| --- | --- | --- |", *rows])


def shares(values: list[Any]) -> str:
    """Return how often each value occurs, most frequent first."""
    return ", ".join(f"{value} {100 * count / len(values):.0f} %" for value, count in Counter(values).most_common())


def rca_table() -> str:
    """Return the statistics of right coronary arteries."""
    patients = patients_of("rca")
    paths = [tree.longest_path() for tree, _ in patients]
    bends = [shape.curvature(path.points) for path in paths]
    right = [patient for patient in patients if patient[1]["dominance"] == "right"]
    rows = [
        line("length from ostium to farthest tip, mm", [p.abscissa[-1] for p in paths], "164 ± 30 (112 to 223)"),
        line("tortuosity", [shape.tortuosity(p.points) for p in paths], "2.07 ± 0.23", 2),
        line("mean curvature, 1/mm", [float(b.mean()) for b in bends], "0.061 ± 0.017", 3),
        line("90th percentile of curvature, 1/mm", [float(np.quantile(b, 0.9)) for b in bends], "0.11 ± 0.04", 3),
    ]
    for share, published in ((0.1, 4.0), (0.2, 3.8), (0.5, 3.5), (0.7, 2.7), (0.9, 2.3)):
        found = [2 * float(np.interp(share * p.abscissa[-1], p.abscissa, p.radius)) for p in paths]
        rows.append(line(f"diameter at {share:.0%} of the path, mm", found, f"{published} ± at most 0.6", 2))
    for section, published in (("1", "3.9"), ("2", "3.4"), ("3", "3.1"), ("4", "2.2")):
        rows.append(
            line(f"diameter of segment {section}, mm (right dominance)", diameters(right, section), published, 2)
        )
    for section, published in (("conus", "15 ± 6"), ("SA", "16 ± 6"), ("AM", "42 ± 8")):
        rows.append(line(f"origin of {section}, mm", origins(patients, section), published))
    dominances = shares([truth["dominance"] for _, truth in patients])
    return table([*rows, f"| dominance | {dominances} | |"])


def lca_table() -> str:
    """Return the statistics of left coronary arteries."""
    patients = patients_of("lca")
    right = [patient for patient in patients if patient[1]["dominance"] == "right"]
    starts = [tree.branches[0].centerline for tree, _ in patients]
    rows = [
        line("length of the left main, mm", drawn(patients, "left_main_length_mm"), "13.1 ± 2.4; 10.8 ± 5.2"),
        line("ostium to the LAD's end, mm", drawn(patients, "length_mm"), ""),
        line("length of the LCx (right dominance), mm", drawn(right, "circumflex_length_mm"), "65 to 80 most often"),
        line("tortuosity of left main and LAD", drawn(patients, "tortuosity"), "", 2),
        line("their mean curvature, 1/mm", drawn(patients, "curvature_mean_per_mm"), "0.055 (one patient)", 3),
        line("diameter of the left main, mm", [2 * float(own.radius[4:-4].mean()) for own in starts], "4.5 ± 0.5", 2),
        line("diameter of segment 6, mm", diameters(patients, "6"), "3.7 ± 0.4 proximal", 2),
        line("diameter of segment 8, mm", diameters(patients, "8"), "1.9 ± 0.4 to 1.1", 2),
        line("diameter of segment 11 (right dominance), mm", diameters(right, "11"), "3.4 ± 0.5", 2),
        line("diameter of the first diagonal, 12 mm on, mm", at_start(patients, "9"), "2.1 to 1.9", 2),
        line("first diagonal beyond the fork, mm", origins(patients, "9", "5"), "about 19"),
        line("first marginal beyond the fork, mm", origins(patients, "12", "5"), "about 13"),
    ]
    dominances = shares([truth["dominance"] for _, truth in patients])
    ramus = 100 * np.mean(drawn(patients, "ramus"))
    return table([*rows, f"| dominance | {dominances} | |", f"| ramus intermedius | {ramus:.0f} % | 15 to 37 % |"])


def arch_table() -> str:
    """Return the statistics of aortic arches."""
    patients = patients_of("arch")
    men = [patient for patient in patients if patient[1]["sex"] == "man"]
    women = [patient for patient in patients if patient[1]["sex"] == "woman"]
    rows = [
        line("height of the arch in men, mm", drawn(men, "arch_height_mm"), "49.3"),
        line("height of the arch in women, mm", drawn(women, "arch_height_mm"), "40.1"),
        line("width of the arch in men, mm", drawn(men, "arch_width_mm"), "83.6"),
        line("width of the arch in women, mm", drawn(women, "arch_width_mm"), "73.3"),
        line("diameter of the descending aorta, mm", diameters(patients, "descending aorta"), "24.3 to 26.1"),
        line("diameter of the arch, mm", diameters(patients, "aortic arch"), "26.1 to 29.4"),
        line("diameter of the ascending aorta, mm", diameters(patients, "ascending aorta"), "30.9 ± 4.1"),
        f"| types | {shares([truth['arch_type'] for _, truth in patients])} | I 61 %, II 34 %, III 5 % |",
        f"| bovine arch | {100 * np.mean(drawn(patients, 'bovine')):.0f} % | 22 % |",
    ]
    return table(rows)


def cerebral_table() -> str:
    """Return the statistics of cerebral arteries."""
    patients = patients_of("cerebral")
    rows = [
        line("cavernous sinus to the carotid's end, mm", drawn(patients, "siphon_length_mm"), "33.1 ± 6.1"),
        line("length of M1, mm", drawn(patients, "m1_length_mm"), "22.5 ± 8.1"),
        line("length of A1, mm", drawn(patients, "a1_length_mm"), "12.7 (7.2 to 18)"),
        line("diameter of the carotid, mm", diameters(patients, "ICA"), "5.0 ± 0.6 to 3.6 ± 0.4", 2),
        line("diameter of M1, mm", diameters(patients, "M1"), "3.1 ± 0.4 at its origin", 2),
        line("diameter of M2, superior trunk, 12 mm on, mm", at_start(patients, "M2 superior"), "2.4 ± 0.4", 2),
        line("diameter of A1, mm", diameters(patients, "A1"), "2.6", 2),
        line("tortuosity of the carotid", drawn(patients, "carotid_tortuosity"), "", 2),
        line("mean curvature of the carotid, 1/mm", drawn(patients, "carotid_curvature_mean_per_mm"), "", 3),
        f"| trunks of M2 | {shares([truth['trunks'] for _, truth in patients])} | 2 87 %, 3 13 % |",
    ]
    return table(rows)


def portal_table() -> str:
    """Return the statistics of portal veins."""
    patients = patients_of("portal")
    rows = [
        line("length of the main portal vein, mm", drawn(patients, "main_length_mm"), "about 80"),
        line("its diameter, mm", diameters(patients, "MPV"), "up to 13"),
        line("diameter of the right branch, mm", diameters(patients, "RPV"), ""),
        line("diameter of the left branch, mm", diameters(patients, "LPV"), ""),
    ]
    kinds = shares([truth["variant"] for _, truth in patients])
    return table([*rows, f"| division | {kinds} | bifurcation 78 %, trifurcation 12 %, right posterior first 10 % |"])


def label_table() -> str:
    """Return how much of the centerline length the labels name right, on two seeds."""
    rows = [
        "| anatomy | right, seed 0 | right, seed 7 | dominance right | worst patient |",
        "| --- | --- | --- | --- | --- |",
    ]
    for one, two in zip(measure_labels(count=40, seed=0), measure_labels(count=40, seed=7), strict=True):
        dominance = ", ".join(f"{row['dominance_right']:.1%}" for row in (one, two))
        worst = min(one["worst_patient"], two["worst_patient"])
        rows.append(f"| {one['anatomy']} | {one['right']:.1%} | {two['right']:.1%} | {dominance} | {worst:.1%} |")
    return "\n".join(rows)


def cost_table(count: int = 5) -> str:
    """Return processor seconds a patient with its distance map, on one core."""
    rows = ["| anatomy | s a patient | 100 patients on 2 cores, min |", "| --- | --- | --- |"]
    for anatomy in VESSELS:
        started = time.process_time()
        for index in range(count):
            make_patient(AtlasConfig(vessel=anatomy, seed=0), index)
        each = (time.process_time() - started) / count
        rows.append(f"| {anatomy} | {each:.2f} | {100 * each / 2 / 60:.1f} |")
    return "\n".join(rows)


def write_tables() -> None:
    """Put every table between its two marks in docs/evidence/atlas.md."""
    for name in ("rca", "lca", "arch", "cerebral", "portal", "label", "cost"):
        fill("evidence/atlas.md", name, globals()[f"{name}_table"]())
        print(name, flush=True)


def draw_tree(axes: Any, tree: VesselTree, anatomy: str) -> None:
    """Draw one tree from the front, coloured by section."""
    colours = plt.get_cmap("tab20")
    across, up = SHOWN[anatomy]
    for branch in tree.branches:
        own = branch.centerline
        for section in np.unique(branch.section[1:]):
            here = np.flatnonzero(branch.section == section)
            here = np.concatenate([[max(here[0] - 1, 0)], here])
            width = (0.45 if anatomy in ("arch", "portal") else 1.6) * own.radius[here].mean()
            axes.plot(own.points[here, across], own.points[here, up], color=colours(section % 20), linewidth=width)
    axes.set_aspect("equal")
    axes.axis("off")


def draw_trees() -> None:
    """Draw six patients of each anatomy."""
    figure, rows = plt.subplots(len(VESSELS), 6, figsize=(12, 12), layout="constrained")
    drawn = ("dominance", "arch_type", "side", "variant")
    for anatomy, row in zip(VESSELS, rows, strict=True):
        for index, axes in enumerate(row):
            tree, truth = make_patient_tree(AtlasConfig(vessel=anatomy, seed=1), index)
            draw_tree(axes, tree, anatomy)
            what = next(f"{truth[name]}" for name in drawn if name in truth)
            axes.set_title(f"{anatomy}: {what}{', bovine' if truth.get('bovine') else ''}", fontsize=8)
    figure.savefig(PICTURES / "atlas.png", dpi=75)


def draw_phantom() -> None:
    """Draw four views of one phantom."""
    figure = plt.figure(figsize=(12, 3.2), layout="constrained")
    volume = make_phantom(make_patient(AtlasConfig(seed=1), 0), config=PhantomConfig(), seed=1)
    voxels, (dx, dy, dz), (x, y, z) = volume.voxels, volume.spacing_mm, volume.origin_mm
    (nz, ny, nx), rows = voxels.shape, [round((at - y) / dy) for at in (-8, -24, 20)]
    axial, coronal = (x, x + nx * dx, y + ny * dy, y), (x, x + nx * dx, z, z + nz * dz)
    views = [
        ("axial, z = 0 mm", voxels[round(-z / dz)], axial),
        ("axial, z = −42 mm", voxels[round((-42 - z) / dz)], axial),
        ("coronal, y = −8 mm", voxels[::-1, rows[0]], coronal),
        ("coronal maximum, 44 mm slab", voxels[::-1, max(rows[1], 0) : rows[2]].max(axis=1), coronal),
    ]
    for place, (title, image, extent) in enumerate(views, start=1):
        axes = figure.add_subplot(1, 4, place)
        axes.imshow(image, cmap="gray", vmin=-200, vmax=700, extent=extent)
        axes.set_title(title, fontsize=9)
        axes.axis("off")
    figure.savefig(PICTURES / "phantom.png", dpi=80)


if __name__ == "__main__":
    draw_trees()
    draw_phantom()
    write_tables()
