"""Some frames of a sequence with the vessel, the line and the tip that was located: `draw_locations`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from endopilot.files import writing
from endopilot.plotting import BLUE, GREY, ORANGE, STYLE, VERMILLION
from endopilot.types import Anatomy
from endopilot.xray.camera import Camera
from endopilot.xray.frames import DeviceFrame
from endopilot.xray.tip_filter import TipLocation

_SHOWN = 4
"""Frames in a picture."""


def draw_locations(
    anatomy: Anatomy,
    locations: Sequence[TipLocation],
    output: str | Path,
    *,
    frames: Sequence[DeviceFrame],
    cameras: Sequence[Camera],
) -> None:
    """Draw some frames of the first camera as PNG: its line, and the vessel where it was moved to.

    The vessel is drawn as it lies at the tip: elsewhere heart and breath may move it otherwise.
    """
    seen = [i for i, frame in enumerate(frames) if frame.lines[0] is not None and locations[i].status != "not found"]
    chosen = [seen[i] for i in np.unique(np.linspace(0, len(seen) - 1, min(_SHOWN, len(seen))).astype(int))]
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(
            1, max(1, len(chosen)), figsize=(3.4 * max(1, len(chosen)), 3.8), squeeze=False, layout="constrained"
        )
        for axis, index in zip(axes[0], chosen, strict=False):
            line, one = frames[index].lines[0], locations[index]
            assert line is not None
            path = anatomy.tree.path(one.branch)
            upto = path.points[path.abscissa <= one.abscissa]
            place, moved = cameras[0].project, one.moved_mm
            for branch in anatomy.tree.branches:
                axis.plot(*place(branch.centerline.points + moved).T, color=GREY, lw=0.7)
            axis.plot(*place(upto + moved).T, color=BLUE, lw=1.6, label="way to the tip")
            axis.plot(*line.T, color=ORANGE, lw=1.6, label="line in the image")
            axis.plot(*place(one.position[None] + moved).T, "o", color=VERMILLION, ms=5, label="tip")
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
        with writing(Path(output)) as partial:
            figure.savefig(partial, format="png", dpi=STYLE["figure.dpi"])
        plt.close(figure)
