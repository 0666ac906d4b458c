"""Lines of a device in the images of a sequence, and where its tip is in each: their files, a picture and a page.

Frames are a CSV file with a row for each point of a line, from the tip backwards; a single row is the tip alone.

==========================  ============================================================================================
column                      meaning
==========================  ============================================================================================
`frame`                     whole number, the same for all points of a frame; frames stand in the order of time
`view`                      1 or 2: which of the cameras; 1 if not given
`column_px`, `row_px`       pixel of the point
==========================  ============================================================================================

Frames whose number is left out show nothing.
"""

from __future__ import annotations

import base64
from collections.abc import Callable, Sequence
from html import escape
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32

from endopilot.files import write_whole
from endopilot.runs import CSV
from endopilot.simulation.csv_file import read_columns
from endopilot.types import Anatomy
from endopilot.xray.carm import Places
from endopilot.xray.line_observations import DeviceFrame, Line
from endopilot.xray.tip_filter import TipLocation

_SHOWN = 4
"""Frames in a picture."""


def read_frames(path: str | Path, *, views: int = 1) -> tuple[DeviceFrame, ...]:
    """Read the lines of a sequence.

    Args:
        path: CSV file of the columns frame, view (if there are several), column_px and row_px.
        views: number of cameras.

    Raises:
        InputError: no such table; the line names file, row, column and mend.
    """
    table = read_columns(Path(path), ["frame", "column_px", "row_px"], ["view"])
    frame, view = table.whole("frame"), table.values.get("view", np.ones(len(table.lines)))
    pixels = np.column_stack([table.values["column_px"], table.values["row_px"]])
    table.ascends("frame", by="frame")
    table.refuse(~np.isin(view, np.arange(1, views + 1)), "view", f"; give 1 to {views}, or a camera for each view")
    found = []
    for number in np.unique(frame):
        lines: list[Line | None] = []
        for k in range(1, views + 1):
            line = pixels[(frame == number) & (view == k)]
            lines.append(line if len(line) else None)
        found.append(DeviceFrame(int(number), tuple(lines)))
    return tuple(found)


def write_locations(locations: Sequence[TipLocation], *, output: str | Path) -> None:
    """Write where the tip is in each frame as a CSV file, whole or not at all; empty cells where it is not found.

    Raises:
        InputError: the suffix is not .csv, or the file cannot be written.
    """
    import pandas as pd

    CSV.files(Path(output))
    upper = [(i, j) for i in range(3) for j in range(i, 3)]
    rows = [
        {
            "frame": one.frame,
            "status": one.status,
            "section": one.section,
            "tip_abscissa_mm": one.abscissa,
            **{f"tip_{axis}_mm": value for axis, value in zip("xyz", one.position, strict=True)},
            **{f"covariance_{'xyz'[i]}{'xyz'[j]}_mm2": one.covariance[i, j] for i, j in upper},
            "share": one.share,
            **{f"moved_{axis}_mm": value for axis, value in zip("xyz", one.moved_mm, strict=True)},
            "residual_mm": one.residual_mm,
        }
        for one in locations
    ]
    write_whole(output, pd.DataFrame(rows).to_csv(index=False, float_format="%.4f"))


def draw_locations(
    anatomy: Anatomy,
    locations: Sequence[TipLocation],
    output: str | Path,
    *,
    lines: Sequence[Float[np.ndarray, "_ 2"] | None],
    project: Callable[[int, Places], Float[np.ndarray, "n 2"]],
    images: Float32[np.ndarray, "frames rows columns"] | None = None,
) -> None:
    """Draw some frames of the first camera as PNG: the device's line, pixels, and the vessel where it lies.

    `project` turns places of the vessel, LPS mm, into the pixels of a frame, given its index; images lie beneath.
    """
    import matplotlib.pyplot as plt

    from endopilot.plotting import BLUE, GREY, ORANGE, STYLE, VERMILLION, png  # slow to import

    seen = [i for i, line in enumerate(lines) if line is not None and locations[i].status != "not found"]
    chosen = [seen[i] for i in np.unique(np.linspace(0, len(seen) - 1, min(_SHOWN, len(seen))).astype(int))]
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(
            1, max(1, len(chosen)), figsize=(3.4 * max(1, len(chosen)), 3.8), squeeze=False, layout="constrained"
        )
        for axis, index in zip(axes[0], chosen, strict=False):
            line, one = lines[index], locations[index]
            assert line is not None
            path = anatomy.tree.path(one.branch)
            upto = path.points[path.abscissa <= one.abscissa]
            if images is not None:
                low, high = np.quantile(images[index], (0.01, 0.99)).tolist()
                axis.imshow(images[index], cmap="gray", vmin=low, vmax=high)
                axis.grid(visible=False)
            for branch in anatomy.tree.branches:
                axis.plot(*project(index, branch.centerline.points).T, color=GREY, lw=0.7)
            axis.plot(*project(index, upto).T, color=BLUE, lw=1.2, label="way to the tip")
            axis.plot(*line.T, color=ORANGE, lw=1.2, label="device in the image")
            axis.plot(*project(index, one.position[None]).T, "o", color=VERMILLION, ms=4, mfc="none", label="tip")
            low, high = line.min(axis=0), line.max(axis=0)
            middle, half = (low + high) / 2, 0.6 * max(float((high - low).max()), 60.0)
            axis.set(
                xlim=(middle[0] - half, middle[0] + half),
                ylim=(middle[1] + half, middle[1] - half),
                aspect="equal",
                title=f"frame {one.frame}: {one.section}, {one.status}",
                xlabel="column, pixels",
            )
        if chosen:
            axes[0][0].legend(loc="lower left")
        write_whole(output, png(figure))
        plt.close(figure)


def write_page(output: Path, *, title: str, said: Sequence[str], picture: Path) -> None:
    """Write one HTML file that needs nothing beside it: what was found, in words and in the picture."""
    image = base64.b64encode(picture.read_bytes()).decode()
    page = f"""<!DOCTYPE html><html lang="en"><meta charset="utf-8"><title>{escape(title)}</title>
<style>body{{font-family:sans-serif;margin:2em}}img{{max-width:100%}}</style>
<h1>{escape(title)}</h1><ul>{"".join(f"<li>{escape(line)}</li>" for line in said)}</ul>
<img alt="frames with vessel, device and tip" src="data:image/png;base64,{image}"></html>
"""
    write_whole(output, page)
