"""The ostium of the right or left coronary artery in a mask or surface without an aorta: found, or asked for."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.ndimage import distance_transform_edt, find_objects, minimum_filter

from endopilot.errors import InputError
from endopilot.imaging.grid import connected_components
from endopilot.types import DistanceMap, Insertion, LumenMask, Volume
from endopilot.vessels import repair, repair_surface
from endopilot.vessels.coronary_ostia import (
    OTHER_AXES,
    Crux,
    OstiumCandidate,
    OstiumRanking,
    Side,
    find_crux,
    rank_ostia,
)
from endopilot.vessels.ends import Skeleton, open_ends, skeleton_of
from endopilot.vessels.inlet import AORTA_RADIUS_MM
from endopilot.vessels.sources import check_unit
from endopilot.vessels.surface import Surface, cropped, distance_map_from_surface, surface_from_mask

CERTAIN = 0.8  # an ostium less probable than this is asked for
PRESENT = 0.5  # the other artery is in the lumen if it begins in another piece with at least this probability
SHORTEST_MM = 15.0  # a lumen whose branches together are shorter than this is no artery but a crumb
GRID_MM = 0.5  # grid spacing at which the arteries are compared, mm

_NAMES = {"rca": "right coronary artery", "lca": "left coronary artery"}
_NAMED, _WORTH_NAMING = 4, 0.02
_SIDES = ("left and right", "front and back", "up and down")
_EVERY = 4  # of the skeleton's points, some 0.6 mm apart, are enough to find vessels in the aorta


@dataclass(frozen=True, eq=False)
class CoronaryInlet:
    """Where a coronary artery begins (LPS mm), with which probability, and the next best place; the `crux` if it is
    known, and where the `other` artery begins, LPS mm, if it is in the lumen as another piece."""

    position: Float[np.ndarray, "3"]
    confidence: float
    runner_up: OstiumCandidate | None
    crux: Crux | None = None
    other: Float[np.ndarray, "3"] | None = None

    def record(self) -> dict[str, object]:
        """Return what `anatomy.json` keeps: `ostium_confidence`, and where else the artery may begin."""
        other = self.runner_up
        return {
            "ostium_confidence": round(self.confidence, 4),
            "ostium_runner_up": other
            and {"position_mm": other.position.round(2).tolist(), "probability": round(other.probability, 4)},
        }


def coronary_inlet(
    content: LumenMask | Surface, side: Side, label: str, coordinates: str | None = None
) -> CoronaryInlet | None:
    """Return where an artery begins, or None where a piece of the aorta in the lumen shows it; `coordinates` are axes
    that the user gave. Raises InputError, which names what to give, for an absent or uncertain artery, or other axes.
    """
    skeletons: list[Skeleton] = []
    coarse = content.volume if isinstance(content, LumenMask) else content
    if isinstance(content, LumenMask) and content.volume.voxels.any():
        corners = np.array([np.zeros(3), np.array(content.volume.voxels.shape[::-1]) - 1.0])
        check_unit(content.volume.index_to_world(corners), None, "rca", label)
        if _holds_aorta(_coarse(content.volume)):
            return None
        coarse = _coarse(repair.pieces_of(content.volume).parted)
    for lumen in _lumens(coarse, label):
        for points, clearance in _parts(lumen):
            if clearance.max() > AORTA_RADIUS_MM:
                return None
            skeletons.append(skeleton_of(points, clearance, lumen.spacing_mm))
    skeletons = [skeleton for skeleton in skeletons if skeleton.costs.sum() >= SHORTEST_MM]
    if not skeletons:
        raise InputError(
            f"{label}: holds no vessel of {SHORTEST_MM:g} mm or more; check the label and the unit (cm: --scale 10)"
        )
    vessels = np.concatenate([skeleton.points[::_EVERY] for skeleton in skeletons])
    pieces = [open_ends(skeleton) for skeleton in skeletons]
    rankings = rank_ostia(pieces, vessels, stated=coordinates is None)
    ranking, counterpart = rankings[side], rankings["lca" if side == "rca" else "rca"]
    best, other = ranking.candidates[0], counterpart.candidates[0]
    if not _is_certain(ranking):
        raise InputError(f"{label}: {_doubt(ranking, counterpart, side, coordinates)}")
    crux, paired = None, other.probability >= PRESENT and other.piece != best.piece
    if paired:
        right, left = (best, other) if side == "rca" else (other, best)
        crux = find_crux(right.position, skeletons[right.piece].points, skeletons[left.piece].points)
    runner_up = ranking.candidates[1] if len(ranking.candidates) > 1 else None
    return CoronaryInlet(best.position, best.probability, runner_up, crux, other.position if paired else None)


def _is_certain(ranking: OstiumRanking) -> bool:
    return ranking.candidates[0].probability >= CERTAIN and ranking.touching.probability <= 0.5


def _doubt(ranking: OstiumRanking, counterpart: OstiumRanking, side: Side, coordinates: str | None) -> str:
    """Say what a lumen may hold instead of an artery with a sure ostium, the likeliest first, and what mends each."""
    other: Side = "lca" if side == "rca" else "rca"
    held = _is_certain(counterpart)
    both = "one lumen seems to hold both coronary arteries, or arteries and veins, which touch: give each its own label"
    rows = [
        *((each.probability, f"it begins there: --ostium-mm {_option(each)}") for each in ranking.candidates[:_NAMED]),
        (ranking.touching.probability, f"{both}, or --ostium-mm {_option(ranking.touching)}"),
        (ranking.axes[1], _in_other_axes(ranking.axes[0], coordinates)),
        (ranking.absent, f"it is the {_NAMES[other]}: take --vessel {other}" if held else "it is not in the file"),
    ]
    likely = sorted((row for row in rows if row[0] > _WORTH_NAMING or row is rows[0]), key=lambda row: -row[0])
    answers = "; or ".join(f"{share:.0%} {text}" for share, text in likely)
    return f"it is not certain where the {_NAMES[side]} begins (LPS, probability): {answers}"


def _in_other_axes(axes: str, coordinates: str | None) -> str:
    """Say in which other axes a file holds what it should, and what to give."""
    exchanged = ", ".join(side for side, sign in zip(_SIDES, OTHER_AXES[axes][0], strict=True) if sign < 0)
    if coordinates is None:
        mend = "mend the orientation that the file states, or export it again"
    elif axes != "ras":
        mend = "export it again in LPS axes"
    else:
        mend = "leave --coordinates ras out" if coordinates == "ras" else "give --coordinates ras"
    return f"with {exchanged} exchanged, what is in it looks as in patients: {mend}"


def _option(candidate: OstiumCandidate) -> str:
    return " ".join(f"{value:.1f}" for value in candidate.position)


def _lumens(content: Volume | Surface, label: str) -> Iterator[DistanceMap]:
    if isinstance(content, Volume):
        if content.voxels.any():
            yield distance_map_from_surface(surface_from_mask(content), spacing_mm=GRID_MM, band_mm=2 * GRID_MM)
        return
    for place in repair_surface.region_places(content):
        wall, _ = repair_surface.closed_surface(content, Insertion(place, np.zeros(3)), label)
        yield distance_map_from_surface(wall, spacing_mm=GRID_MM, band_mm=2 * GRID_MM)


def _parts(lumen: DistanceMap) -> Iterator[tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n"]]]:
    labels = connected_components(lumen.values > 0, corners=True)
    for number, box in enumerate(find_objects(labels), start=1):
        own = labels[box] == number
        corner = np.array([part.start for part in box])
        index = np.argwhere(own) + corner
        if len(index) > 100:
            yield lumen.origin_mm + lumen.spacing_mm * index[:, ::-1], lumen.values[tuple(index.T)].astype(float)


def _holds_aorta(coarse: Volume) -> bool:
    """Return whether a mask is somewhere too thick for a coronary artery, at a fraction of its wall's cost."""
    # A ball holds a cube of its radius over √3; without such a cube the costly distance need not be asked.
    cube = 2 * np.floor(AORTA_RADIUS_MM / np.sqrt(3.0) / coarse.spacing_mm[::-1]).astype(int) - 1
    if not minimum_filter(coarse.voxels, size=np.maximum(cube, 1), mode="constant").any():
        return False
    depth = np.asarray(distance_transform_edt(coarse.voxels, sampling=coarse.spacing_mm[::-1]))
    return bool(depth.max(initial=0.0) > AORTA_RADIUS_MM)


def _coarse(mask: Volume) -> Volume:
    """Return a mask cropped to what is in it, of voxels no finer than the ostia are looked for at."""
    mask, _ = cropped(mask)
    factor = np.maximum(np.floor(GRID_MM / mask.spacing_mm + 0.2).astype(int), 1)
    if (factor == 1).all():
        return mask
    from skimage.measure import block_reduce

    block = tuple(int(size) for size in factor[::-1])
    shares = block_reduce(mask.voxels.astype(np.float32), block, np.mean)  # pyright: ignore[reportArgumentType]
    origin = mask.index_to_world((factor - 1) / 2.0)
    return replace(mask, voxels=shares >= 0.5, spacing_mm=mask.spacing_mm * factor, origin_mm=origin)
