"""How much cines look like those of clinics, by figures of 42 public ones: `looks`. How the body goes on beyond a CT:
`body_beyond`."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pydicom
from jaxtyping import Float
from PIL import Image
from scipy.ndimage import binary_dilation, distance_transform_edt, gaussian_filter, uniform_filter

from benchmarks.figures import Bar
from endopilot.angiograms.cine import CLASSES
from endopilot.angiograms.config import AngiogramsConfig
from endopilot.atlas.atlas import AtlasConfig, make_patient
from endopilot.phantom.chest import place
from endopilot.phantom.phantom import make_phantom
from endopilot.types import Volume
from endopilot.xray.absorbers import SURROUNDINGS
from endopilot.xray.carm import CArmGeometry, view_at
from endopilot.xray.image import isocenter_of
from endopilot.xray.projector import cast

BARS: dict[str, tuple[Bar, Bar]] = {
    name: (Bar(low, at_least=True), Bar(high))
    for name, low, high in (
        ("background_range", 0.3, 0.7),
        ("clipped_labels", 0.0, 0.0),
        ("contrast_over_background", 0.27, 0.48),
        ("noise_correlation", 0.7, 0.9),
        ("contrast_to_6_px", 0.7 * 0.12, 1.3 * 0.12),
        ("contrast_6_to_11_px", 0.7 * 0.18, 1.3 * 0.18),
        ("contrast_from_11_px", 0.7 * 0.30, 1.3 * 0.30),
        ("wire_coil_contrast", 0.08, 0.20),
        ("empty_catheter_contrast", 0.13, 0.22),
    )
}
"""Lower and upper bars: real cines' quartiles, or their medians and 30 % on either side."""
_WIDTHS = {"contrast_to_6_px": (0, 6), "contrast_6_to_11_px": (6, 11), "contrast_from_11_px": (11, 1000)}
_AROUND_PX, _BESIDE_PX = 4, 10.0
"""Background begins this far from labels, and stands for a place within this standard deviation, pixels."""
_BLOCK = 24


def looks(cines: Sequence[Path]) -> dict[str, Any]:
    """Measure cines as they are written.

    Returns:
        For each of `BARS` the `median` over the cines, the quartiles, the bars and whether the median `passed`; and
        the medians of `vessel_width_px`, on the centerlines, and of their `length_px` in the image.
    """
    found: dict[str, list[float]] = defaultdict(list)
    for folder in cines:
        for name, value in _measured(folder).items():
            if np.isfinite(value):
                found[name].append(value)
    figures: dict[str, Any] = {}
    for name, values in found.items():
        low, median, high = np.percentile(values, (25, 50, 75))
        figures[name] = {"median": round(float(median), 3), "quartiles": [round(float(low), 3), round(float(high), 3)]}
        if name in BARS:
            least, most = BARS[name]
            figures[name] |= {"bars": [round(least.limit, 3), round(most.limit, 3)]}
            figures[name]["passed"] = least.met(float(median)) and most.met(float(median))
    return figures


def _measured(folder: Path) -> dict[str, float]:
    """Return the figures of one cine; NaN where it does not show what they are of."""
    truth = np.load(folder / "truth.npz")
    header = pydicom.dcmread(folder / "cine.dcm")
    centre, width, per_e = float(header.WindowCenter), float(header.WindowWidth), 2 * AngiogramsConfig().image.window
    light = (header.pixel_array.astype(float) - centre) / width * per_e
    count = len(light)
    masks, grey = (
        np.stack([np.asarray(Image.open(folder / part / f"{k:04d}.png")) for k in range(count)])
        for part in ("masks", "frames")
    )
    field = np.zeros(light.shape[1:], dtype=bool)
    left, right = int(header.ShutterLeftVerticalEdge), int(header.ShutterRightVerticalEdge)
    upper, lower = int(header.ShutterUpperHorizontalEdge), int(header.ShutterLowerHorizontalEdge)
    field[upper + 8 : lower - 8, left + 8 : right - 8] = True
    fullest = int(np.argmax([((mask & CLASSES["contrast"]) > 0).sum() for mask in masks]))
    labels, shown = masks[fullest] > 0, light[fullest]
    off = field & ~np.asarray(binary_dilation(labels, iterations=_AROUND_PX), dtype=bool)
    background = float(np.ptp(np.percentile(shown[off], (5, 95))))
    figures = {"background_range": background, "noise_correlation": _correlation(grey)}
    inside = np.zeros_like(field)
    inside[upper + 2 : lower - 2, left + 2 : right - 2] = True
    figures["clipped_labels"] = float((np.isin(grey, (0, 255)) & (masks > 0) & inside).mean())
    contrast = (masks[fullest] & CLASSES["contrast"]) > 0
    if contrast.any():
        devices = (masks[fullest] & (CLASSES["guide"] | CLASSES["wire"] | CLASSES["catheter"])) > 0
        wide = 2 * np.asarray(distance_transform_edt(contrast))
        places = np.rint(truth["centerline_px"][fullest][truth["centerline_contrast"][fullest] > 0.5]).astype(int)
        column, row = np.unique(places[((places >= 0) & (places < len(shown))).all(axis=1)], axis=0).T
        kept = (field & contrast & ~devices)[row, column]
        row, column = row[kept], column[kept]
        depth, lumen = _beside(shown, off)[row, column] - shown[row, column], wide[row, column]
        figures |= {"contrast_over_background": float(np.median(depth)) / background}
        figures |= {"vessel_width_px": float(np.median(lumen)), "length_px": float(len(row))}
        for name, (low, high) in _WIDTHS.items():
            within = (lumen >= low) & (lumen < high)
            figures[name] = float(np.median(depth[within])) if within.sum() > 20 else np.nan
    empty = masks[0]  # no contrast yet
    off = field & ~np.asarray(binary_dilation(empty > 0, iterations=_AROUND_PX), dtype=bool)
    depth = _beside(light[0], off) - light[0]
    devices = CLASSES["guide"] | CLASSES["wire"] | CLASSES["catheter"]
    for name, line in (("empty_catheter_contrast", "guide"), ("wire_coil_contrast", "wire")):
        if f"{line}_px" in truth:
            nodes, along = truth[f"{line}_px"][0], truth[f"{line}_mm"][0]
            nodes = nodes[np.linalg.norm(along - along[0], axis=1) < 30]
            nodes = np.rint(nodes[np.isfinite(nodes).all(axis=1)]).astype(int)
            column, row = nodes[((nodes >= 0) & (nodes < len(shown))).all(axis=1)].T
            near = np.zeros_like(field)
            near[row, column] = True
            alone = field & ((empty & devices) == CLASSES[line]) & binary_dilation(near, iterations=_AROUND_PX)
            if alone.sum() > 50:  # a coil is thinner than its pixels: its middle counts
                figures[name] = (
                    float(np.median(depth[alone])) if line == "guide" else float(np.quantile(depth[alone], 0.9))
                )
    return figures


def _beside(light: Float[np.ndarray, "r c"], off: np.ndarray) -> Float[np.ndarray, "r c"]:
    """Return the background's mean around each pixel."""
    weight = gaussian_filter(off.astype(float), _BESIDE_PX) + 1e-9
    return gaussian_filter(np.where(off, light, 0.0), _BESIDE_PX) / weight


def _correlation(grey: np.ndarray) -> float:
    """Return the correlation of neighbours' noise: of frames less those before, in the quietest quarter of squares."""
    found = []
    for before, after in pairwise(grey):
        noise = after.astype(float) - before
        rows, columns = (np.arange(64, side - 64 - _BLOCK, _BLOCK) for side in noise.shape)
        power = uniform_filter(noise**2, _BLOCK)[np.ix_(rows + _BLOCK // 2, columns + _BLOCK // 2)]
        for index in np.argsort(power.ravel())[: power.size // 4]:
            i, j = divmod(int(index), len(columns))
            block = noise[rows[i] :, columns[j] :][:_BLOCK, :_BLOCK]
            block = block - block.mean()
            if block.any():
                found.append(float((block[:, 1:] * block[:, :-1]).mean() / (block**2).mean()))
    return float(np.median(found)) if found else np.nan


def body_beyond(angles_deg: Sequence[tuple[float, float]] = ((-30, -25), (40, 25), (50, -30), (0, 35))) -> list[float]:
    """Return how far the image of a CT that ends 60 mm beyond the vessel is off that of the whole chest: 5 to 95 % of
    the difference of line integrals, powers of e, for each view; the exposure control takes what they have in common.
    """
    anatomy = make_patient(AtlasConfig(vessel="rca", seed=33), 0)
    coarse = replace(SURROUNDINGS, in_plane_mm=2.5, slice_mm=2.5, margin_mm=130.0)
    whole, points = make_phantom(anatomy, config=coarse), anatomy.tree.line.points
    index = np.stack(np.meshgrid(*map(np.arange, whole.voxels.shape), indexing="ij")[::-1], axis=-1)
    heart = place(anatomy.tree)
    across = (
        whole.index_to_world(index) - heart.from_reference(np.array([[12.0, 12.0, -40.0]]))[0]
    )  # the chest's middle
    outside = ((across[..., :2] / (165 * heart.scale, 108 * heart.scale)) ** 2).sum(axis=-1) > 1
    whole = replace(whole, voxels=np.where(outside, -1000.0, whole.voxels))
    low, high = (whole.world_to_index(end).astype(int) for end in (points.min(axis=0) - 60, points.max(axis=0) + 60))
    low = np.maximum(low, 0)
    part = whole.voxels[low[2] : high[2], low[1] : high[1], low[0] : high[0]]
    cut = Volume(part, whole.spacing_mm, whole.index_to_world(low.astype(float)), whole.direction)
    off = []
    for angles in angles_deg:
        view = view_at(angles, isocenter_of(anatomy), CArmGeometry())
        error = cast(cut, view, 512, 64) - cast(whole, view, 512, 64)
        off.append(round(float(np.ptp(np.percentile(error, (5, 95)))), 2))
    return off
