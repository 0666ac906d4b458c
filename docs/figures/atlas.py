"""Print the statistics of docs/atlas.md and draw its picture: `python docs/figures/atlas.py`."""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl
import numpy as np

from endopilot.anatomy import atlas_shape as shape
from endopilot.anatomy.atlas import AtlasConfig, synthesize_one, synthesize_tree
from endopilot.anatomy.phantom import PhantomConfig, make_phantom

mpl.use("Agg")
import matplotlib.pyplot as plt

PICTURE = Path(__file__).parents[1] / "images" / "atlas.png"


def print_statistics(count: int = 100) -> None:
    """Print mean, standard deviation and range over the patients of seed 0."""
    patients = [synthesize_tree(AtlasConfig(seed=0), index) for index in range(count)]
    trees = [tree for tree, _ in patients]
    paths = [tree.longest_path() for tree in trees]
    bends = [shape.curvature(path.points) for path in paths]
    rows = {
        "length, mm": [path.abscissa[-1] for path in paths],
        "tortuosity": [shape.tortuosity(path.points) for path in paths],
        "mean curvature, 1/mm": [bend.mean() for bend in bends],
        "90th percentile of curvature, 1/mm": [np.quantile(bend, 0.9) for bend in bends],
    }
    for share in (0.1, 0.2, 0.5, 0.7, 0.9):
        rows[f"diameter at {share:.0%}, mm"] = [
            2 * np.interp(share * path.abscissa[-1], path.abscissa, path.radius) for path in paths
        ]
    right = [tree for tree, truth in patients if truth["dominance"] == "right"]
    for name in ("1", "2", "3", "4"):
        rows[f"diameter of segment {name}, mm"] = [
            2 * np.mean(np.concatenate([b.centerline.radius[b.section == int(name) - 1] for b in tree.branches]))
            for tree in right
        ]
    for name in ("conus", "SA", "RV", "AM"):
        number = trees[0].section_names.index(name)
        rows[f"origin of {name}, mm"] = [
            b.centerline.abscissa[0] for tree in trees for b in tree.branches if np.all(b.section == number)
        ]
    for name, values in rows.items():
        print(f"{name:36} n {len(values):3} {np.mean(values):8.3f} ± {np.std(values, ddof=1):.3f}")


def draw() -> None:
    """Draw six trees coloured by section, and four views of one phantom."""
    figure = plt.figure(figsize=(12, 6.2), layout="constrained")
    top, bottom = figure.subfigures(2, 1, height_ratios=(1.05, 1))
    colours = plt.get_cmap("tab10")
    for index in range(6):
        tree, truth = synthesize_tree(AtlasConfig(seed=1), index)
        axes = top.add_subplot(1, 6, 1 + index)
        for branch in tree.branches:
            line = branch.centerline
            for section in np.unique(branch.section[1:]):
                here = np.flatnonzero(branch.section == section)
                width = 2 * line.radius[here].mean()
                axes.plot(line.points[here, 0], line.points[here, 2], color=colours(section), linewidth=width)
        axes.set(aspect="equal", xlim=(-52, 62), ylim=(-100, 25))
        axes.set_title(f"{truth['dominance']}, {truth['length_mm']:.0f} mm", fontsize=9)
        axes.axis("off")
    volume = make_phantom(synthesize_one(AtlasConfig(seed=1), 0), PhantomConfig(), 1)
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
        axes = bottom.add_subplot(1, 4, place)
        axes.imshow(image, cmap="gray", vmin=-200, vmax=700, extent=extent)
        axes.set_title(title, fontsize=9)
        axes.axis("off")
    figure.savefig(PICTURE, dpi=80)


if __name__ == "__main__":
    print_statistics()
    draw()
