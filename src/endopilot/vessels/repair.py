"""Repairs of flaws of masks from elsewhere: blobs, gaps, cavities; their remarks go into the provenance."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped
from scipy.ndimage import binary_fill_holes, distance_transform_edt
from scipy.spatial import KDTree

from endopilot.errors import InputError, place_text
from endopilot.imaging.grid import connected_components
from endopilot.types import Insertion, Volume
from endopilot.vessels.graph import split
from endopilot.vessels.inlet import COMPARABLE, Vessel, piece_on_side
from endopilot.vessels.medial_lines import MedialLines, piece_labels
from endopilot.vessels.remarks import NOTED_MM, longest_first
from endopilot.vessels.surface import cropped
from endopilot.vessels.topology import SMALLEST_PIECE, Touch, parted, touch_remarks

NEAR_OSTIUM_MM = 5.0  # a lumen farther than this from a given ostium does not belong to it
LARGEST_GAP_VOXELS = 4.0  # pieces of a mask that are this near each other are taken for one interrupted vessel

_DIRECTION_VOXELS = 12.0  # a piece's direction at its end is that of its voxels within this distance
_ONWARDS = 0.5  # cosine of the largest angle between a piece and the gap that it is joined across

_MOST_JOINED = 200  # at most this many pieces of a mask are looked at as vessels or parts of them

_OTHER_SIDE = {"rca": "left coronary artery", "lca": "right coronary artery"}


@dataclass(frozen=True, eq=False)
class Lumen:
    """One lumen of a mask, ready for its wall, with its middle and remarks on what was joined, parted and left out."""

    mask: Volume
    lines: MedialLines
    notes: list[str]


@dataclass(frozen=True, eq=False)
class Pieces:
    """The pieces of a mask: `joined` over gaps of a few voxels to what carries on, and `parted` where they touch, with
    its middle `lines`; `gaps` has a voxel at each, and whether it was joined."""

    joined: Volume
    gaps: list[tuple[Int[np.ndarray, "3"], bool]]
    parted: Volume
    touches: list[Touch]
    lines: MedialLines


@lru_cache(maxsize=1)
def pieces_of(mask: Volume) -> Pieces:
    """Return the pieces of a mask that holds some; the last mask's are kept: several stages ask for them."""
    own, _ = cropped(mask)
    joined, gaps = _joined(own.voxels)
    read = replace(own, voxels=joined)
    return Pieces(read, gaps, *parted(read))


def connected_mask(
    mask: Volume,
    given: Insertion | None,
    label: str,
    vessel: Vessel = "generic",
) -> Lumen:
    """Return the one lumen at the ostium, or the largest: gaps of a few voxels bridged, cavities filled, blobs removed.

    Places where it touches itself are parted (`topology.parted`). Where a mask holds both coronary arteries and no
    ostium is given, `vessel` decides by the patient's side. Raises InputError for a mask that is empty, full, a solid
    block or noise, or that touches nothing near the given ostium (LPS mm).
    """
    if not mask.voxels.any():
        raise InputError(f"{label}: the mask is empty; check the label or segment again")
    if mask.voxels.all():
        raise InputError(f"{label}: the mask is a solid block (every voxel belongs to it); segment the vessel alone")
    _refuse_blocks_and_noise(cropped(mask)[0].voxels, label)
    whole = pieces_of(mask)
    labels, read = piece_labels(whole.parted), piece_labels(whole.joined)
    index = np.argwhere(whole.parted.voxels)
    pieces = split(whole.parted.index_to_world(index[:, ::-1].astype(float)), labels[tuple(index.T)] - 1)
    sizes = np.array([len(piece) for piece in pieces])
    main, gap, nearest = chosen_piece(pieces, sizes, given, vessel)
    if gap > max(NEAR_OSTIUM_MM, 2.0 * float(mask.spacing_mm.max())):
        raise InputError(
            f"{label}: the mask touches nothing near the ostium at {place_text(given.position)}; "  # pyright: ignore[reportOptionalMemberAccess]
            f"its nearest voxel is {gap:.1f} mm away at {place_text(nearest)}"
        )
    if sizes[main] < SMALLEST_PIECE:
        raise InputError(f"{label}: the lumen has only {sizes[main]} voxels; check the label or segment again")
    result = labels == main + 1
    own = read == read[result][0]  # all that the file connects with it
    severed = np.setdiff1d(labels[own] - 1, [-1, main])
    remarks = touch_remarks([touch for touch in whole.touches if _holds(whole.joined, own, touch.place)])
    joints = [joined for place, joined in whole.gaps if own[tuple(place)]]
    if beside := joints.count(False):
        remarks.append(f"{beside} pieces that run alongside the lumen, not on from it, were not joined to it")
    if joints.count(True):
        remarks.append(f"{joints.count(True)} gaps of up to {LARGEST_GAP_VOXELS:g} voxels bridged")
    remarks += pieces_left_out(pieces, [main], severed, vessel, "voxels")
    lumen, corner = cropped(replace(whole.joined, voxels=result))
    closed = np.asarray(binary_fill_holes(lumen.voxels), dtype=bool)
    if closed.sum() > sizes[main]:
        remarks.append(f"cavities of {int(closed.sum() - sizes[main])} voxels filled")
    lines = whole.lines.within(result[tuple(whole.lines.index.T)], corner)
    return Lumen(replace(lumen, voxels=closed), lines, remarks)


def _holds(mask: Volume, voxels: Bool[np.ndarray, "nz ny nx"], place: Float[np.ndarray, "3"]) -> bool:
    at = np.rint(mask.world_to_index(place)).astype(int)[::-1]
    return bool(voxels[tuple(slice(max(0, i - 2), i + 3) for i in at)].any())


def _refuse_blocks_and_noise(voxels: Bool[np.ndarray, "nz ny nx"], label: str) -> None:
    share = float(voxels.mean())
    count = int(voxels.sum())
    padded = np.pad(voxels, 1)
    walls = sum(int(np.count_nonzero(np.diff(padded.astype(np.int8), axis=axis))) for axis in range(3))
    radius = 2.0 * count / walls
    if count > 500 and share > 0.03 and radius < 0.9:
        raise InputError(f"{label}: the mask is noise ({share:.0%} of its box, in specks); segment the vessel again")
    if share > 0.9 and min(voxels.shape) > 3 and max(voxels.shape) < 4 * min(voxels.shape):
        raise InputError(f"{label}: the mask is a solid block ({share:.0%} of its box); segment the vessel alone")


def chosen_piece(
    pieces: list[Float[np.ndarray, "_ 3"]], sizes: Shaped[np.ndarray, "p"], given: Insertion | None, vessel: Vessel
) -> tuple[int, float, Float[np.ndarray, "3"]]:
    """Return the piece at the ostium, or without one that on the vessel's side (`piece_on_side`), how far away it is,
    mm, and where. A speck of noise is no piece."""
    if given is None:
        main = piece_on_side(sizes.astype(float), np.array([piece.mean(axis=0) for piece in pieces]), vessel)
        return main, 0.0, pieces[main][0]
    found = []
    for number, piece in enumerate(pieces):
        if len(piece) >= min(SMALLEST_PIECE, max(map(len, pieces))):
            gap = np.linalg.norm(piece - given.position, axis=1)
            found.append((float(gap.min()), number, int(gap.argmin())))
    gap, main, at = min(found)
    return main, gap, pieces[main][at]


def pieces_left_out(
    pieces: list[Float[np.ndarray, "_ 3"]],
    taken: list[int],
    severed: Int[np.ndarray, "_"],
    vessel: Vessel,
    counted: str,
) -> list[str]:
    """Say which pieces (points, LPS mm, of `counted`) were left out and where they lie: a real vessel may be lost with
    them. The lumen is made of `taken`; `severed` touched it and were parted from it."""
    lumen, reach, found = np.concatenate([pieces[number] for number in taken]), None, []
    for number in (number for number in range(len(pieces)) if number not in taken):
        place = pieces[number]
        extent, kind = float(np.linalg.norm(np.ptp(place, axis=0))), "a piece apart from the lumen"
        if extent < NOTED_MM:  # is told with others at most
            found.append((extent, kind))
            continue
        reach = reach or KDTree(lumen)
        some = np.asarray(reach.query(place[:: len(place) // 64 + 1])[0]).min()  # so that far points end a search early
        gap = np.asarray(reach.query(place, distance_upper_bound=some + 1e-6)[0])
        if number in severed:
            kind = "another vessel that touches this one"
        elif len(place) >= COMPARABLE * len(lumen):
            kind = f"another vessel, perhaps the {_OTHER_SIDE[vessel]}," if vessel in _OTHER_SIDE else "another vessel"
            kind += " apart from the lumen, which --ostium-mm chooses,"
        where = f"begins {gap.min():.1f} mm away at {place_text(place[gap.argmin()])}"
        found.append((extent, f"{kind} left out ({len(place)} {counted}): it is {extent:.0f} mm long and {where}"))
    return longest_first(found, "{} more pieces apart from the lumen, {:.0f} mm together, left out")


def _joined(
    voxels: Bool[np.ndarray, "nz ny nx"],
) -> tuple[Bool[np.ndarray, "nz ny nx"], list[tuple[Int[np.ndarray, "3"], bool]]]:
    """Join pieces within the largest gap by tubes as wide as the vessels, unless one runs alongside the other; return
    the voxels, and for each gap a voxel at it and whether it was bridged."""
    labels, index = connected_components(voxels, corners=True), np.argwhere(voxels)
    members = split(index, labels[tuple(index.T)] - 1)
    large = sorted(range(len(members)), key=lambda piece: -len(members[piece]))[:_MOST_JOINED]
    left = [piece for piece in large if len(members[piece]) >= SMALLEST_PIECE]
    gaps, result = list[tuple[np.ndarray, bool]](), voxels.copy()
    clearance: np.ndarray | None = None  # where nothing is joined it is not needed
    while len(left) > 1:
        here, asked, beside = members[left.pop(0)], list(left), list[int]()
        reach = KDTree(here)
        while asked:
            piece = asked.pop(0)
            gap, nearest = map(np.asarray, reach.query(members[piece], distance_upper_bound=LARGEST_GAP_VOXELS))
            best = int(gap.argmin())
            if not np.isfinite(gap[best]):
                continue
            start, end = here[nearest[best]], members[piece][best]
            onwards = _carries_on(here, start, end) or _carries_on(members[piece], end, start)
            gaps.append((start, onwards))
            beside += [piece] * (not onwards)
            if onwards:
                clearance = np.asarray(distance_transform_edt(voxels)) if clearance is None else clearance
                _draw_tube(result, start, end, min(_widest(clearance, start), _widest(clearance, end)))
                left.remove(piece)
                here, asked = np.concatenate([here, members[piece]]), [other for other in left if other not in beside]
                reach = KDTree(here)
    return result, gaps


def _carries_on(voxels: Int[np.ndarray, "n 3"], end: Int[np.ndarray, "3"], beyond: Int[np.ndarray, "3"]) -> bool:
    """Return whether a piece points from its voxel `end` to a place beyond, or is too short to point anywhere."""
    relative = (voxels - end).astype(float)
    near = relative[np.linalg.norm(relative, axis=1) < _DIRECTION_VOXELS]
    spread, axes = np.linalg.eigh(np.cov(near.T)) if len(near) > 3 else (np.ones(3), np.eye(3))
    if spread[2] < 3.0 * spread[1]:
        return True
    direction = (beyond - end) / max(float(np.linalg.norm(beyond - end)), 1e-9)
    return bool(abs(axes[:, 2] @ direction) > _ONWARDS)


def _widest(clearance: np.ndarray, place: np.ndarray) -> float:
    window = tuple(slice(max(0, i - 4), i + 5) for i in place)
    return float(clearance[window].max())


def _draw_tube(voxels: np.ndarray, start: np.ndarray, end: np.ndarray, width: float) -> None:
    reach = int(np.ceil(width)) + 1
    lower = np.maximum(np.minimum(start, end) - reach, 0)
    upper = np.minimum(np.maximum(start, end) + reach + 1, voxels.shape)
    grid = np.stack(np.meshgrid(*(np.arange(a, b) for a, b in zip(lower, upper, strict=True)), indexing="ij"), axis=-1)
    along = (end - start).astype(float)
    share = np.clip((grid - start) @ along / max(float(along @ along), 1e-9), 0.0, 1.0)
    gap = np.linalg.norm(grid - start - share[..., None] * along, axis=-1)
    window = tuple(slice(a, b) for a, b in zip(lower, upper, strict=True))
    voxels[window] |= gap <= max(width, 1.0)
