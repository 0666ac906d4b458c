"""`locate` on lines as others make them, chains of pixels, noise, cut away, into the catheter: `bench_lines`."""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from endopilot.anatomy.extract import extract_anatomy
from endopilot.runs import Existing
from endopilot.settings import Seed
from endopilot.types import Anatomy
from endopilot.xray.camera import CArmCamera, read_camera
from endopilot.xray.carm import CArmGeometry
from endopilot.xray.frames import DeviceFrame, read_frames
from endopilot.xray.tip_filter import LocateConfig, TipLocation, locate

sys.path.append(str(Path(__file__).parents[2] / "examples"))

Line = Float[np.ndarray, "n 2"]
NEAR_MM, OF_95 = 5.0, 2.795
"""A tip is right within this, mm; 95 % of normal errors in space lie within so many standard deviations."""
CHOSEN = 37
"""Frames of the liver's before this one chose the filter's constants; the others are the test."""
_GUIDE_MM, _GUIDE_RADIUS_MM = 90.0, 40.0
"""Guiding catheter before the ostium, and the radius of its bend, mm: as in an aortic root, assumed."""


@dataclass(frozen=True)
class Judged:
    """What `locate` reaches on lines of one kind.

    Attributes:
        lines: how they were made.
        frames: number of frames.
        right_share: tips within 5 mm.
        right_or_said_share: these, and tips of which it said that it is not sure of 5 mm.
        median_mm: error of tips that were found.
        inside_own_95_share: errors within its own 95 % region, of tips that were found.
        sure_and_wrong_share: "found", more than 5 mm off and outside its 95 % region.
    """

    lines: str
    frames: int
    right_share: float
    right_or_said_share: float
    median_mm: float
    inside_own_95_share: float
    sure_and_wrong_share: float


def judge(name: str, found: Sequence[TipLocation], truth: Float[np.ndarray, "n 3"]) -> Judged:
    """Return how far tips lie from where they should."""
    error = np.array([one.position - place for one, place in zip(found, truth, strict=True)])
    there = np.isfinite(error).all(axis=1)
    size = np.where(there, np.linalg.norm(error, axis=1), np.inf)
    off = [np.sqrt(e @ np.linalg.solve(one.covariance, e)) for e, one in zip(error, found, strict=True) if there.any()]
    inside, right = np.array(off) < OF_95, size <= NEAR_MM
    sure = np.array([one.status == "found" for one in found])
    return Judged(
        lines=name,
        frames=len(found),
        right_share=round(float(right.mean()), 3),
        right_or_said_share=round(float((right | ~sure).mean()), 3),
        median_mm=round(float(np.median(size[there])), 2) if there.any() else np.nan,
        inside_own_95_share=round(float(inside[there].mean()), 3) if there.any() else np.nan,
        sure_and_wrong_share=round(float((sure & ~right & ~inside).mean()), 3),
    )


def skeleton(line: Line) -> Line:
    """Return a line as a segmentation gives it: drawn one pixel wide, thinned, and ordered from its tip."""
    from skimage.draw import line as drawn
    from skimage.graph import route_through_array
    from skimage.morphology import skeletonize

    low = np.floor(line.min(axis=0)).astype(int) - 2
    whole = np.round(line - low).astype(int)
    image = np.zeros(whole.max(axis=0) + 3, dtype=bool)
    for start, end in pairwise(whole):
        image[drawn(*start, *end)] = True
    cost = np.where(skeletonize(image), 1.0, 1e4)
    path, _ = route_through_array(cost, whole[0], whole[-1], fully_connected=True)
    return np.array(path, dtype=float) + low


def noisy(line: Line, random: np.random.Generator) -> Line:
    """Return a line whose points err by 3 px, each by itself."""
    return line + 3.0 * random.standard_normal(line.shape)


def shortened(line: Line) -> Line:
    """Return a line without the tenth that is farthest from the tip."""
    return line[: max(2, round(0.9 * len(line)))]


def gap(line: Line) -> Line:
    """Return a line without a tenth in its middle."""
    low, high = round(0.45 * len(line)), round(0.55 * len(line))
    return np.concatenate([line[:low], line[high:]])


def changed(frames: Sequence[DeviceFrame], change: Callable[[Line], Line]) -> tuple[DeviceFrame, ...]:
    """Return frames whose lines are changed."""
    return tuple(replace(one, lines=tuple(None if k is None else change(k) for k in one.lines)) for one in frames)


def enlarged(camera: CArmCamera, factor: float) -> CArmCamera:
    """Return a C-arm whose detector is taken to stand farther away by a factor."""
    geometry = replace(camera.geometry, source_to_detector_mm=factor * camera.geometry.source_to_detector_mm)
    return replace(camera, geometry=geometry)


def kinds(
    frames: tuple[DeviceFrame, ...], cameras: Sequence[CArmCamera], random: np.random.Generator
) -> dict[str, tuple[tuple[DeviceFrame, ...], Sequence[CArmCamera]]]:
    """Return frames and cameras of each kind."""
    return {
        "as they are": (frames, cameras),
        "skeletons": (changed(frames, skeleton), cameras),
        "3 px of noise": (changed(frames, lambda line: noisy(line, random)), cameras),
        "geometry 2 % too large": (frames, [enlarged(one, 1.02) for one in cameras]),
        "geometry 2 % too small": (frames, [enlarged(one, 0.98) for one in cameras]),
        "every fourth frame": (frames[::4], cameras),
        "a tenth cut away behind": (changed(frames, shortened), cameras),
        "a tenth missing in the middle": (changed(frames, gap), cameras),
    }


def wire_into_catheter(
    anatomy: Anatomy, cameras: Sequence[CArmCamera], random: np.random.Generator, count: int = 12, guide_mm: float = 0.0
) -> tuple[tuple[DeviceFrame, ...], Float[np.ndarray, "n 3"]]:
    """Return exact lines of a wire pushed along a tree's longest branch, from a guiding catheter on, and its tips."""
    leaf = max(anatomy.tree.leaves(), key=lambda one: anatomy.tree.path(one).abscissa[-1])
    path = anatomy.tree.path(leaf)
    start = anatomy.insertion
    aside = np.cross(start.direction, random.standard_normal(3))
    aside /= np.linalg.norm(aside)
    angle = np.arange(0.5, guide_mm, 0.5)[:, None] / _GUIDE_RADIUS_MM
    back = _GUIDE_RADIUS_MM * (np.sin(angle) * -start.direction + (1 - np.cos(angle)) * aside)
    frames, tips = [], []
    for number, tip in enumerate(np.linspace(20.0, path.abscissa[-1] - 3.0, count)):
        at = np.arange(tip, 0.0, -0.5)
        inside = np.stack([np.interp(at, path.abscissa, axis) for axis in path.points.T], axis=-1)
        device = np.concatenate([inside, path.points[0] + back])
        frames.append(DeviceFrame(number, tuple(camera.project(device) for camera in cameras)))
        tips.append(device[0])
    return tuple(frames), np.array(tips)


def bench_lines(
    *, liver: Existing | None = None, trees: tuple[Existing, ...] = (), seed: Seed = 1
) -> list[dict[str, Any]]:
    """Measure `locate` on chains of pixels, noise, lines cut away or into a catheter, and geometry that is off.

    Args:
        liver: folder of the published liver, whose authors' tips are taken for the truth; frames 37 to 73 are judged.
        trees: coronary trees, as `endopilot anatomy` makes or takes them: exact lines in two views.
        seed: of noise and of the catheter's bend.
    """
    judged, random = [], np.random.default_rng(seed)
    if liver is not None:
        from liver_catheter import convert, nodes_of  # pyright: ignore[reportMissingImports]  (examples/)

        with tempfile.TemporaryDirectory() as scratch:
            whole = convert(liver / "dataset1", Path(scratch))
            camera, frames = read_camera(Path(scratch) / "c-arm.yaml"), read_frames(Path(scratch) / "lines.csv")
        assert isinstance(camera, CArmCamera)
        table = np.genfromtxt(liver / "authors_hmm_bruteforce_run.csv", delimiter=",", names=True)
        authors = nodes_of(liver / "dataset1")[0][table["tip_node"].astype(int)]
        x, y, z = (float(value) for value in authors[0])
        config = LocateConfig(landmark_mm=(x, y, z))
        for name, (some, cameras) in kinds(frames, [camera], random).items():
            found = locate(whole, frames=some, cameras=cameras, config=config)
            for part, of in (("0 to 36", found[: _before(found)]), ("37 to 73", found[_before(found) :])):
                judged.append(judge(f"liver, {part}, {name}", of, authors[[one.frame for one in of]]))
    for path in trees:
        tree = extract_anatomy(path)
        x, y, z = (float(value) for value in tree.tree.branches[0].centerline.points.mean(axis=0))
        for name, guide in (("cut at the ostium", 0.0), ("into the catheter", _GUIDE_MM)):
            cameras = [
                CArmCamera(angles_deg=a, isocenter_mm=(x, y, z), centre_px=(512.0, 512.0), geometry=CArmGeometry())
                for a in ((-30.0, 0.0), (60.0, 0.0))
            ]
            frames, tips = wire_into_catheter(tree, cameras, random, guide_mm=guide)
            for kind, (some, views) in kinds(frames, cameras, random).items():
                found = locate(tree, frames=some, cameras=views)
                judged.append(judge(f"{tree.name}, {name}, {kind}", found, tips[[one.frame for one in found]]))
    return [asdict(one) for one in judged]


def _before(found: Sequence[TipLocation]) -> int:
    """Return the number of frames that belong to the first half."""
    return sum(one.frame < CHOSEN for one in found)
