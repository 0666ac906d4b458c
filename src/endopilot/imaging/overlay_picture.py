"""A picture of a segmentation: three slices of the CT with the mask's outline."""

from __future__ import annotations

from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from jaxtyping import Float

from endopilot.files import writing
from endopilot.imaging.grid import mask_like
from endopilot.types import LumenMask, Volume

_WINDOW_HU = (-150.0, 650.0)
_PLANES = (("axial", 2), ("coronal", 1), ("sagittal", 0))


def draw_overlay(
    volume: Volume,
    mask: LumenMask,
    path: str | Path,
    *,
    reference: LumenMask | None = None,
    through: Float[np.ndarray, "3"] | None = None,
) -> None:
    """Write a PNG of three slices, the mask outlined in green and a reference in red, on any grids. They pass `through`
    an LPS position, mm, or each where the mask's section is largest."""
    outlines = [(mask_like(mask, volume), "lime")]
    if reference is not None:
        outlines.append((mask_like(reference, volume), "red"))
    figure, axes = plt.subplots(1, 3, figsize=(15, 5.5), facecolor="black", layout="constrained")
    for plot, (name, axis) in zip(axes, _PLANES, strict=True):
        array_axis = 2 - axis
        if through is not None:
            position = int(np.round(volume.world_to_index(through)[axis]))
        else:
            position = int(outlines[0][0].sum(axis=tuple({0, 1, 2} - {array_axis})).argmax())
        height, width = (volume.spacing_mm[2 - other] for other in range(3) if other != array_axis)
        plot.imshow(
            np.take(volume.voxels, position, axis=array_axis),
            cmap="gray",
            vmin=_WINDOW_HU[0],
            vmax=_WINDOW_HU[1],
            origin="upper" if name == "axial" else "lower",
            aspect=height / width,
        )
        for inside, colour in outlines:
            section = np.take(inside, position, axis=array_axis)
            if section.any():
                plot.contour(section, [0.5], colors=colour, linewidths=0.9)
        place = volume.index_to_world(np.full(3, position, dtype=float))[axis]
        plot.set_title(f"{name}, {'xyz'[axis]} = {place:.0f} mm", color="white")
        plot.axis("off")
    with writing(Path(path)) as partial:
        figure.savefig(partial, dpi=110, facecolor="black")
    plt.close(figure)
