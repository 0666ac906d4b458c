"""A picture of a segmentation: slices of the CT through it, with the outlines of masks."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import matplotlib
import numpy as np
import SimpleITK as sitk
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from endopilot.files import writing
from endopilot.imaging.aortic_root import box_around
from endopilot.imaging.grid import from_image, mask_like, to_image
from endopilot.types import LumenMask, Volume

_WINDOW_HU = (-150.0, 650.0)  # from fat to well-filled lumen
_MARGIN_MM = 18.0  # what is shown of the volume around the vessel, mm
_PLANES = (("axial", 2), ("coronal", 1), ("sagittal", 0))


def draw_slices(
    axes: Iterable[Axes],
    volume: Volume,
    outlines: Sequence[tuple[LumenMask, str]],
    *,
    through: Float[np.ndarray, "3"] | None = None,
) -> None:
    """Draw an axial, a coronal and a sagittal slice of a CT, as many as there are axes, as radiologists read them and
    cropped to the first mask, with masks' outlines in their colours. Slices pass `through` a position, LPS mm, or each
    where the mask's section is largest."""
    ct = from_image(sitk.DICOMOrient(to_image(volume), "LPS"))
    insides = [(mask_like(mask, ct), colour) for mask, colour in outlines]
    first, spacing = insides[0][0], ct.spacing_mm
    crop = box_around(np.argwhere(first), _MARGIN_MM / spacing[::-1], first.shape)
    for plot, (name, axis) in zip(axes, _PLANES, strict=False):
        across = 2 - axis
        largest = int(first.sum(axis=tuple({0, 1, 2} - {across})).argmax())
        position = largest if through is None else round(float(ct.world_to_index(through)[axis]))
        position = min(max(position, 0), first.shape[across] - 1)
        at = (*crop[:across], position, *crop[across + 1 :])
        height, width = (spacing[2 - other] for other in range(3) if other != across)
        origin = "upper" if name == "axial" else "lower"
        how = {"vmin": _WINDOW_HU[0], "vmax": _WINDOW_HU[1], "aspect": height / width}
        plot.imshow(ct.voxels[at], cmap="gray", origin=origin, **how)
        for inside, colour in insides:
            if inside[at].any():
                plot.contour(inside[at], [0.5], colors=colour, linewidths=0.9)
        place = ct.index_to_world(np.full(3, position, dtype=float))[axis]
        plot.set_title(f"{name}, {'xyz'[axis]} = {place:.0f} mm")
        plot.axis("off")


def draw_overlay(
    volume: Volume,
    mask: LumenMask,
    path: str | Path,
    *,
    reference: LumenMask | None = None,
    through: Float[np.ndarray, "3"] | None = None,
) -> None:
    """Write a PNG of three slices, the mask outlined in green and a reference in red, on any grids."""
    outlines = [(mask, "lime"), *(() if reference is None else ((reference, "red"),))]
    with matplotlib.rc_context({"axes.titlecolor": "white"}):
        figure = Figure(figsize=(15, 5.5), facecolor="black", layout="constrained")
        draw_slices(figure.subplots(1, 3), volume, outlines, through=through)
    with writing(Path(path)) as partial:
        figure.savefig(partial, format="png", dpi=110, facecolor="black")
