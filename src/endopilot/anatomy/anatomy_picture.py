"""A picture of an anatomy: the tree by section and by radius, its longest path straightened, and cross-sections."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl

mpl.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from jaxtyping import Float
from matplotlib.cm import ScalarMappable
from matplotlib.collections import PolyCollection
from matplotlib.colors import Normalize
from matplotlib.patches import Patch
from scipy.ndimage import map_coordinates

from endopilot.anatomy.distance import sample
from endopilot.anatomy.projection import project_tip
from endopilot.anatomy.tree import tangents
from endopilot.anatomy.wall_mesh import wall_mesh
from endopilot.files import write_whole
from endopilot.lines import places_on
from endopilot.plotting import plain_text, png, section_colors
from endopilot.types import Anatomy, Centerline, Volume

SECTIONS = 6  # cross-sections that are drawn, evenly along the longest path

WINDOW_HU = (-150.0, 650.0)
_WIDTH = 15.0  # of the picture, inches
_LONGEST_NAME, _MOST_LISTED = 24, 120  # letters of a section's name, and sections, that are listed
_MOST_TRIANGLES = 200_000
_LIGHT = np.array([-0.35, -0.8, 0.5]) / np.linalg.norm([-0.35, -0.8, 0.5])


def draw_anatomy(anatomy: Anatomy, path: Path, *, volume: Volume | None = None) -> None:
    """Write a PNG of the tree, its longest path as a straightened reformation, and cross-sections, with walls (green)
    and inscribed circles (yellow) on a CT in HU, or on the distance to the wall."""
    figure = plt.figure(figsize=(_WIDTH, 13), facecolor="white", layout="constrained")
    parts: Any = figure.subfigures(3, 1, height_ratios=(2.0, 1.15, 1.0))
    top, middle, bottom = parts
    _draw_tree(anatomy, top)
    line = anatomy.tree.longest_path()
    half = 2.2 * float(np.quantile(line.radius, 0.95)) + 1.0
    _draw_straightened(anatomy, line, half, volume, middle)
    _draw_sections(anatomy, line, half, volume, bottom)
    write_whole(path, png(figure, dpi=90))
    plt.close(figure)


def _draw_tree(anatomy: Anatomy, figure: Any) -> None:
    vertices, faces = wall_mesh(anatomy.distance_map, max_triangles=_MOST_TRIANGLES)
    tree = anatomy.tree
    corners = vertices[faces]
    place = project_tip(tree, anatomy.insertion, corners.mean(axis=1))
    catheter, radius, section = place.abscissa < 0, place.radius, np.zeros(len(corners), dtype=int)
    for index, branch in enumerate(tree.branches):
        own = place.branch == index
        at = np.searchsorted(branch.centerline.abscissa, place.abscissa[own])
        section[own] = branch.section[np.minimum(at, len(branch.section) - 1)]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    shade = 0.45 + 0.55 * np.abs(normal @ _LIGHT)
    order = np.argsort(-corners[:, :, 1].mean(axis=1))  # from the back (large y) to the front
    present = np.unique(section)
    palette = section_colors(len(present))
    scale = Normalize(float(radius.min()), float(radius.max()))
    number = np.searchsorted(present, section)
    for axes, title in zip(figure.subplots(1, 2), ("sections", "radius, mm"), strict=True):
        colour = palette(number) if title == "sections" else plt.get_cmap("viridis")(scale(radius))
        colour = np.where(catheter[:, None], [0.75, 0.75, 0.75, 1.0], colour)
        colour[:, :3] *= shade[:, None]
        visible = list(corners[order][:, :, [0, 2]])
        axes.add_collection(PolyCollection(visible, facecolors=colour[order], edgecolors="none"))
        axes.set(aspect="equal", title=title, xlabel="x (to the patient's left), mm", ylabel="z (to the head), mm")
        axes.autoscale_view()
        if title == "sections":
            _list_sections(figure, [tree.section_names[s] for s in present], palette)
        else:
            figure.colorbar(ScalarMappable(scale, "viridis"), cax=axes.inset_axes((1.03, 0.0, 0.03, 1.0)))


def _list_sections(figure: Any, names: Sequence[str], palette: Any) -> None:
    shown = [name if len(name) <= _LONGEST_NAME else f"{name[: _LONGEST_NAME - 1]}…" for name in names[:_MOST_LISTED]]
    handles = [Patch(color=palette(i), label=plain_text(name)) for i, name in enumerate(shown)]
    if len(names) > len(shown):
        handles.append(Patch(color="none", label=f"and {len(names) - len(shown)} more"))
    handles.append(Patch(color="0.75", label="catheter"))
    width = 0.45 + 0.075 * max(len("catheter"), *map(len, shown))  # of a column, inches
    columns = min(len(handles), int(_WIDTH / width))
    figure.legend(handles=handles, fontsize=8, loc="outside lower center", ncols=columns, columnspacing=1.0)


def _draw_straightened(anatomy: Anatomy, line: Centerline, half: float, volume: Volume | None, figure: Any) -> None:
    count = max(2, int(line.abscissa[-1] / 0.2))
    at = np.linspace(0.0, float(line.abscissa[-1]), count)
    points, normals, directions = (
        places_on(values, line.abscissa, at) for values in (line.points, line.normals, tangents(line.points))
    )
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    across = np.linspace(-half, half, 81)
    rows = figure.subplots(2, 1, sharex=True)
    for axes, (title, side) in zip(
        rows, (("normal", normals), ("binormal", np.cross(directions, normals))), strict=True
    ):
        grid = points[None] + across[:, None, None] * side[None]
        _show(axes, anatomy, grid, (0.0, float(at[-1]), -half, half), volume)
        axes.set(ylabel=f"{title}, mm")
        axes.plot(at, 0 * at, color="yellow", linewidth=0.5)
    rows[-1].set_xlabel("abscissa along the longest path, mm")


def _draw_sections(anatomy: Anatomy, line: Centerline, half: float, volume: Volume | None, figure: Any) -> None:
    places = np.linspace(0.03, 0.97, SECTIONS) * float(line.abscissa[-1])
    direction = tangents(line.points)
    circle = np.linspace(0.0, 2 * np.pi, 73)
    across = np.linspace(-half, half, 81)
    for axes, place in zip(figure.subplots(1, SECTIONS), places, strict=True):
        centre, normal, tangent = (
            places_on(values, line.abscissa, np.array([place]))[0] for values in (line.points, line.normals, direction)
        )
        binormal = np.cross(tangent, normal)
        grid = centre + across[None, :, None] * normal + across[:, None, None] * binormal
        _show(axes, anatomy, grid, (-half, half, -half, half), volume)
        radius = float(np.interp(place, line.abscissa, line.radius))
        axes.plot(radius * np.cos(circle), radius * np.sin(circle), color="yellow", linewidth=0.8)
        axes.set(title=f"{place:.0f} mm, r = {radius:.2f} mm", aspect="equal", xticks=[], yticks=[])


def _show(
    axes: Any,
    anatomy: Anatomy,
    grid: Float[np.ndarray, "h w 3"],
    extent: tuple[float, float, float, float],
    volume: Volume | None,
) -> None:
    """Show the CT, or the distance to the wall, on a grid of points, with the wall as a white line."""
    shape, points = grid.shape[:2], grid.reshape(-1, 3)
    distance = sample(anatomy.distance_map, points).reshape(shape)
    if volume is None:
        limit = float(np.abs(distance).max())
        axes.imshow(distance, extent=extent, origin="lower", cmap="RdGy_r", vmin=-limit, vmax=limit, aspect="auto")
    else:
        index = volume.world_to_index(points)[:, ::-1].T
        hu = map_coordinates(volume.voxels, index, order=1, cval=-1000.0, output=np.float32).reshape(shape)
        axes.imshow(hu, extent=extent, origin="lower", cmap="gray", vmin=WINDOW_HU[0], vmax=WINDOW_HU[1], aspect="auto")
    if distance.min() < 0 < distance.max():
        axes.contour(distance, [0.0], extent=extent, origin="lower", colors="lime", linewidths=0.9)
