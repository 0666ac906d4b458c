"""Repairs of the flaws that masks from elsewhere have: blobs, gaps, cavities. `repair_surface` is that of surfaces.

Every repair returns remarks, which `extract_anatomy` writes into the provenance.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import center_of_mass, distance_transform_edt, find_objects
from scipy.spatial import KDTree

from endopilot.anatomy.medial_lines import MedialLines, piece_labels
from endopilot.anatomy.parent_vessel import COMPARABLE, Vessel, piece_on_side
from endopilot.anatomy.surface import filled_box
from endopilot.anatomy.topology import MOST_LISTED, SMALLEST_PIECE, Touch, parted, touch_remarks
from endopilot.errors import InputError, place_text
from endopilot.imaging.grid import connected_components
from endopilot.types import Insertion, Volume

NEAR_OSTIUM_MM = 5.0
"""A lumen farther than this from a given ostium does not belong to it."""

LARGEST_GAP_VOXELS = 4.0
"""Pieces of a mask that are this near each other are taken for one interrupted vessel."""

_DIRECTION_VOXELS = 12.0
"""A piece's direction at its end is that of its voxels within this distance."""

_ONWARDS = 0.5
"""Cosine of the largest angle between a piece and the gap that it is joined across."""

NOTED_MM = 5.0
"""What is left out or widened gets a remark of its own from this length; shorter pieces are summed up."""

_MOST_JOINED = 200
"""At most this many pieces of a mask are looked at as vessels or parts of them."""

OTHER_SIDE = {"rca": "left coronary artery", "lca": "right coronary artery"}


@dataclass(frozen=True, eq=False)
class Lumen:
    """One lumen of a mask, ready for its wall.

    Attributes:
        mask: its voxels.
        lines: their middle.
        before: middle of all that the file connects with it: what the tree should reach.
        told: which points of `before` lie in another vessel that was parted from this one, and that a remark names.
        notes: remarks on what was joined, parted and left out.
    """

    mask: Volume
    lines: MedialLines
    before: MedialLines
    told: Bool[np.ndarray, "_"]
    notes: list[str]


@dataclass(frozen=True, eq=False)
class Pieces:
    """The pieces of a mask, without specks.

    Attributes:
        joined: voxels as they were read, and over gaps of a few voxels to what carries on.
        gaps: a voxel at each gap, and whether what lies beyond was joined or runs alongside.
        specks: voxels that are no vessel.
        parted: the joined voxels, parted where they touch.
        touches: what touches.
        before: middle of the joined voxels.
        lines: middle of the parted ones.
    """

    joined: Volume
    gaps: list[tuple[Int[np.ndarray, "3"], bool]]
    specks: Bool[np.ndarray, "nz ny nx"]
    parted: Volume
    touches: list[Touch]
    before: MedialLines
    lines: MedialLines


@lru_cache(maxsize=1)
def pieces_of(mask: Volume) -> Pieces:
    """Return the pieces of a mask that holds some; the last mask's are kept: several stages ask for them."""
    box = filled_box(mask.voxels)
    voxels = np.asarray(mask.voxels[box], dtype=bool)
    origin = mask.index_to_world(np.array([part.start for part in box][::-1], dtype=float))
    labels = connected_components(voxels, corners=True)
    sizes = np.bincount(labels[voxels])
    order = np.argsort(-sizes, kind="stable")[:_MOST_JOINED]
    order = order[sizes[order] >= min(SMALLEST_PIECE, sizes.max())]
    large = voxels if len(order) == labels.max() else np.isin(np.arange(len(sizes)), order)[labels]
    joined, gaps = _joined(large, labels, order)
    read = replace(mask, voxels=joined, origin_mm=origin)
    return Pieces(read, gaps, voxels & ~large, *parted(read))


def connected_mask(
    mask: Volume,
    given: Insertion | None,
    label: str,
    vessel: Vessel = "generic",
    other_ostium: Float[np.ndarray, "3"] | None = None,
) -> Lumen:
    """Return the one lumen at the ostium, or the largest: gaps of a few voxels bridged, cavities filled, blobs removed.

    Places where it touches itself are parted (`topology.parted`). Where a mask holds both coronary arteries and no
    ostium is given, `vessel` decides by the patient's side.

    Args:
        mask: one or several lumens, and specks.
        given: the ostium, if it is known.
        label: name of the source, for messages.
        vessel: which vessel is wanted.
        other_ostium: ostium of the other coronary artery, LPS mm, if it is known.

    Raises:
        InputError: the mask is empty, full, a solid block, noise, or touches nothing near the given ostium.
    """
    if not mask.voxels.any():
        raise InputError(f"{label}: the mask is empty; check the label or segment again")
    if mask.voxels.all():
        raise InputError(f"{label}: the mask is a solid block (every voxel belongs to it); segment the vessel alone")
    _refuse_blocks_and_noise(np.asarray(mask.voxels[filled_box(mask.voxels)], dtype=bool), label)
    whole = pieces_of(mask)
    labels, read = piece_labels(whole.parted), piece_labels(whole.joined)
    sizes = np.bincount(labels[whole.parted.voxels])
    if given is None:
        main, others = _piece_on_side(whole.parted, labels, sizes, vessel)
    else:
        main, others = _nearest_piece(whole.parted, labels, sizes, given, label), []
    if sizes[main] < SMALLEST_PIECE:
        raise InputError(f"{label}: the lumen has only {sizes[main]} voxels; check the label or segment again")
    result = labels == main
    own = read == read[result][0]  # all that the file connects with it
    foreign = _piece_at(whole.parted, labels, sizes, other_ostium)
    severed = np.setdiff1d(labels[own], [0, main])
    remarks = touch_remarks([touch for touch in whole.touches if _holds(whole.joined, own, touch.place)])
    joints = [joined for place, joined in whole.gaps if own[tuple(place)]]
    if beside := joints.count(False):
        remarks.append(f"{beside} pieces that run alongside the lumen, not on from it, were not joined to it")
    if apart := np.setdiff1d(others, [foreign, *severed]).tolist():
        remarks.append(other_pieces_text(vessel, len(apart)))
    if joints.count(True):
        remarks.append(f"{joints.count(True)} gaps of up to {LARGEST_GAP_VOXELS:g} voxels bridged")
    if foreign:
        remarks.append(f"the {OTHER_SIDE[vessel]} ({sizes[foreign]} voxels) is not part of this one")
    remarks += _left_out(whole, result, labels, foreign, severed, vessel)
    box = filled_box(result)
    corner = np.array([part.start for part in box])
    closed = _filled(result[box])
    if closed.sum() > sizes[main]:
        remarks.append(f"cavities of {int(closed.sum() - sizes[main])} voxels filled")
    lumen = replace(mask, voxels=closed, origin_mm=whole.joined.index_to_world(corner[::-1].astype(float)))
    lines = whole.lines.part(result[tuple(whole.lines.index.T)], corner)
    before = whole.before.part(own[tuple(whole.before.index.T)], corner)
    told = np.isin(labels[tuple((before.index + corner).T)], severed)
    return Lumen(lumen, lines, before, told, remarks)


def _holds(mask: Volume, voxels: Bool[np.ndarray, "nz ny nx"], place: Float[np.ndarray, "3"]) -> bool:
    """Return whether some voxels lie at a place, LPS mm, or next to it."""
    at = np.rint(mask.world_to_index(place)).astype(int)[::-1]
    return bool(voxels[tuple(slice(max(0, i - 2), i + 3) for i in at)].any())


def _filled(voxels: Bool[np.ndarray, "nz ny nx"]) -> Bool[np.ndarray, "nz ny nx"]:
    """Return voxels with the cavities inside them."""
    outside = connected_components(np.pad(~voxels, 1, constant_values=True))
    return (outside != outside[0, 0, 0])[1:-1, 1:-1, 1:-1]


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


def _nearest_piece(mask: Volume, labels: np.ndarray, sizes: np.ndarray, given: Insertion, label: str) -> int:
    """Return the label of the piece at the ostium; a speck of noise beside it does not count."""
    index = np.argwhere(labels > 0)
    index = index[sizes[labels[tuple(index.T)]] >= min(SMALLEST_PIECE, sizes.max())]
    gap = np.linalg.norm(mask.index_to_world(index[:, ::-1].astype(float)) - given.position, axis=1)
    if gap.min() > max(NEAR_OSTIUM_MM, 2.0 * float(mask.spacing_mm.max())):
        nearest = mask.index_to_world(index[gap.argmin()][::-1].astype(float))
        raise InputError(
            f"{label}: the mask touches nothing near the ostium at {place_text(given.position)}; "
            f"its nearest voxel is {gap.min():.1f} mm away at {place_text(nearest)}"
        )
    return int(labels[tuple(index[gap.argmin()])])


def _piece_at(mask: Volume, labels: np.ndarray, sizes: np.ndarray, place: Float[np.ndarray, "3"] | None) -> int:
    """Return the label of the piece at a place, 0 if there is none."""
    if place is None:
        return 0
    index = np.argwhere(labels > 0)
    index = index[sizes[labels[tuple(index.T)]] >= SMALLEST_PIECE]
    gap = np.linalg.norm(mask.index_to_world(index[:, ::-1].astype(float)) - place, axis=1)
    return int(labels[tuple(index[gap.argmin()])]) if len(gap) and gap.min() < NEAR_OSTIUM_MM else 0


def _left_out(
    whole: Pieces,
    result: Bool[np.ndarray, "nz ny nx"],
    labels: Int[np.ndarray, "nz ny nx"],
    foreign: int,
    severed: Int[np.ndarray, "_"],
    vessel: Vessel,
) -> list[str]:
    """Say which pieces were left out and where they lie, since a real vessel may be lost with them.

    Args:
        whole: all pieces.
        result: the lumen.
        labels: number of each piece.
        foreign: number of the other coronary artery, 0 if it is not there or not known.
        severed: numbers of those that touched the lumen and were parted from it.
        vessel: which vessel is wanted.
    """
    mask = whole.parted
    if whole.specks.any():
        labels = labels + np.where(whole.specks, piece_labels(replace(mask, voxels=whole.specks)) + labels.max(), 0)
    sizes = np.bincount(labels[mask.voxels | whole.specks])
    lost = np.setdiff1d(np.flatnonzero(sizes), [0, labels[result][0], foreign])
    if len(lost) == 0:
        return []
    boxes = find_objects(labels)
    corners = np.array([[[part.start, part.stop - 1] for part in boxes[piece - 1]] for piece in lost])
    extent = np.linalg.norm(np.diff(corners, axis=2)[..., 0] * mask.spacing_mm[::-1], axis=1)
    order = np.argsort(-extent, kind="stable")
    reach = KDTree(mask.index_to_world(np.argwhere(result)[:, ::-1].astype(float)))
    remarks = []
    for number in order[:MOST_LISTED]:
        if extent[number] < NOTED_MM:
            break
        piece = lost[number]
        own = np.argwhere(labels[boxes[piece - 1]] == piece) + corners[number, :, 0]
        place = mask.index_to_world(own[:, ::-1].astype(float))
        gap = np.asarray(reach.query(place)[0])
        at, apart = place_text(place[gap.argmin()]), "apart from the lumen"
        begins = f"begins {gap.min():.1f} mm away at {at}"
        kind = "a piece"
        if piece in severed:
            kind, apart, begins = "another vessel", "that touches this one", f"touches it at {at}"
        elif sizes[piece] >= COMPARABLE * result.sum():
            kind = "another vessel, " + (
                f"perhaps the {OTHER_SIDE[vessel]}," if vessel in OTHER_SIDE else "or a part not connected in the file,"
            )
        remarks.append(
            f"{kind} {apart} left out ({sizes[piece]} voxels): it is {extent[number]:.0f} mm long and {begins}"
        )
    rest = order[len(remarks) :]
    if len(rest):
        kind = "more pieces" if remarks else "pieces apart from the lumen"
        longest, size = float(extent[rest].max()), int(sizes[lost[rest]].sum())
        remarks.append(f"{len(rest)} {kind} of up to {longest:.0f} mm left out ({size} voxels)")
    return remarks


def _joined(
    voxels: Bool[np.ndarray, "nz ny nx"], labels: Int[np.ndarray, "nz ny nx"], order: Int[np.ndarray, "_"]
) -> tuple[Bool[np.ndarray, "nz ny nx"], list[tuple[Int[np.ndarray, "3"], bool]]]:
    """Join pieces that lie within the largest gap by tubes as wide as the vessels at both ends.

    Two vessels that pass each other are not one: a piece that runs alongside another is not joined to it.

    Args:
        voxels: the pieces.
        labels: number of each.
        order: these numbers, the largest piece first.

    Returns:
        The voxels, and for each gap a voxel at it and whether it was bridged.
    """
    index = np.argwhere(voxels)
    index = index[np.argsort(labels[tuple(index.T)], kind="stable")]
    numbers, starts = np.unique(labels[tuple(index.T)], return_index=True)
    members = dict(zip(numbers.tolist(), np.split(index, starts[1:]), strict=True))
    left, gaps, result = order.tolist(), list[tuple[np.ndarray, bool]](), voxels.copy()
    clearance: np.ndarray | None = None  # where nothing is joined it is not needed
    while len(left) > 1:
        here, asked = members[left.pop(0)], list(left)
        while asked:
            reach = KDTree(here)
            found = [
                (piece, *map(np.asarray, reach.query(members[piece], distance_upper_bound=LARGEST_GAP_VOXELS)))
                for piece in asked
            ]
            found = [each for each in found if np.isfinite(each[1].min())]
            if not found:
                break
            asked, grown = [piece for piece in asked if piece not in [each[0] for each in found]], False
            for piece, gap, nearest in found:
                best = int(gap.argmin())
                start, end = here[nearest[best]], members[piece][best]
                onwards = _carries_on(here, start, end) or _carries_on(members[piece], end, start)
                gaps.append((start, onwards))
                if onwards:
                    clearance = np.asarray(distance_transform_edt(voxels)) if clearance is None else clearance
                    _draw_tube(result, start, end, min(_widest(clearance, start), _widest(clearance, end)))
                    left.remove(piece)
                    members[piece], here = members[piece][:0], np.concatenate([here, members[piece]])
                    grown = True
            if not grown:
                break
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


def _piece_on_side(mask: Volume, labels: np.ndarray, sizes: np.ndarray, vessel: Vessel) -> tuple[int, list[int]]:
    """Return the label of the wanted piece of a mask, and those of the others that are nearly as large."""
    large = np.flatnonzero(sizes >= COMPARABLE * sizes.max())
    index = np.array(center_of_mass(labels > 0, labels, large))[:, ::-1]
    chosen, others = piece_on_side(sizes[large].astype(float), mask.index_to_world(index), vessel)
    return int(large[chosen]), [int(large[other]) for other in others]


def other_pieces_text(vessel: Vessel, count: int) -> str:
    """Return the remark on other pieces that are nearly as large as the one taken."""
    choice = (
        "the largest was taken: for coronary arteries give --vessel rca or lca"
        if vessel == "generic"
        else f"the one on the {vessel.upper()}'s side was taken"
    )
    pieces = "1 other large piece lies" if count == 1 else f"{count} other large pieces lie"
    return f"{pieces} apart and {choice}; --ostium-mm chooses another"
