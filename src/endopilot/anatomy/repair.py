"""Repairs of the flaws that masks from elsewhere have: blobs, gaps, cavities. `repair_surface` is that of surfaces.

Every repair returns remarks, which `extract_anatomy` writes into the provenance.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import binary_fill_holes, center_of_mass, distance_transform_edt, find_objects
from scipy.spatial import KDTree

from endopilot.anatomy.parent_vessel import COMPARABLE, Vessel, piece_on_side
from endopilot.anatomy.surface import filled_box
from endopilot.anatomy.topology import parted
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

SMALLEST_PIECE = 12
"""A piece of fewer voxels is noise."""

NOTED_MM = 5.0
"""What is left out or widened gets a remark of its own from this length; shorter pieces are summed up."""

MOST_LISTED = 8
"""As many pieces are listed one by one."""

MOST_PIECES = 12
"""At most this many pieces of a mask are looked at as coronary arteries or parts of them."""


def connected_mask(
    mask: Volume,
    given: Insertion | None,
    label: str,
    vessel: Vessel = "generic",
    other_ostium: Float[np.ndarray, "3"] | None = None,
) -> tuple[Volume, list[str]]:
    """Return the one lumen at the ostium, or the largest: gaps of a few voxels bridged, cavities filled, blobs removed.

    Loops of it and places where it touches itself are cut (`topology.parted`). Where a mask holds both coronary
    arteries and no ostium is given, `vessel` decides by the patient's side.

    Args:
        mask: one or several lumens, and specks.
        given: the ostium, if it is known.
        label: name of the source, for messages.
        vessel: which vessel is wanted.
        other_ostium: ostium of the other coronary artery, LPS mm, if it is known.

    Raises:
        InputError: the mask is empty, full, a solid block, noise, or touches nothing near the given ostium.
    """
    box = filled_box(mask.voxels)
    if box[0].stop == 0:
        raise InputError(f"{label}: the mask is empty; check the label or segment again")
    if mask.voxels.all():
        raise InputError(f"{label}: the mask is a solid block (every voxel belongs to it); segment the vessel alone")
    corner = np.array([part.start for part in box])
    voxels = np.asarray(mask.voxels[box], dtype=bool)
    _refuse_blocks_and_noise(voxels, label)
    cropped = replace(mask, voxels=voxels, origin_mm=mask.index_to_world(corner[::-1].astype(float)))
    labels, sizes, main, others = _pieces(cropped, given, label, vessel)
    own, piece = _cut_out(cropped, labels == main)
    whole, remarks = parted(piece)
    severed: set[int] = set()  # what was cut off must not be bridged again
    if remarks:
        cropped = replace(cropped, voxels=voxels.copy())
        cropped.voxels[own] &= ~piece.voxels | whole.voxels
        labels, sizes, main, others = _pieces(cropped, given, label, vessel)
        severed = {int(number) for number in np.unique(labels[own][whole.voxels])}
    result, count = labels == main, len(sizes) - 1
    if count > 1:
        pieces = [int(piece) for piece in np.argsort(-sizes)[: min(count, 200)] if piece != main]
        foreign = _piece_at(cropped, labels, sizes, other_ostium)
        near = [p for p in pieces if sizes[p] >= SMALLEST_PIECE and p not in (foreign, *severed)]
        result, joined, beside = _bridged(result, labels, near)
        if beside:
            remarks.append(f"{beside} pieces that run alongside the lumen, not on from it, were not joined to it")
        apart = [piece for piece in others if piece != foreign and not result[labels == piece].any()]
        if apart:
            remarks.append(other_pieces_text(vessel, len(apart)))
        if joined:
            remarks.append(f"{joined} gaps of up to {LARGEST_GAP_VOXELS:g} voxels bridged")
        if foreign:
            other = "left" if vessel == "rca" else "right"
            remarks.append(f"the {other} coronary artery ({sizes[foreign]} voxels) is not part of this one")
        remarks += _left_out(cropped, result, labels, sizes, foreign)
    if result.sum() < SMALLEST_PIECE:
        raise InputError(f"{label}: the lumen has only {int(result.sum())} voxels; check the label or segment again")
    _, lumen = _cut_out(cropped, result)
    closed = binary_fill_holes(lumen.voxels)
    assert closed is not None
    if closed.sum() > lumen.voxels.sum():
        remarks.append(f"cavities of {int(closed.sum() - lumen.voxels.sum())} voxels filled")
    return replace(lumen, voxels=closed), remarks


def joined_mask(mask: Volume) -> Volume:
    """Return a mask in which each of the largest pieces is joined to what carries it on; specks are left out."""
    voxels = np.asarray(mask.voxels, dtype=bool)
    labels = connected_components(voxels, corners=True)
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    pieces = [int(piece) for piece in np.argsort(-sizes)[:MOST_PIECES] if sizes[piece] >= SMALLEST_PIECE]
    result = np.zeros_like(voxels)
    for piece in pieces:
        own = labels == piece
        if result[own].any():
            continue
        others = [other for other in pieces if other != piece and not result[labels == other].any()]
        result |= _bridged(own, labels, others)[0]
    return replace(mask, voxels=result)


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


def _pieces(
    mask: Volume, given: Insertion | None, label: str, vessel: Vessel
) -> tuple[np.ndarray, np.ndarray, int, list[int]]:
    """Return the connected pieces' labels and sizes, the wanted one, and others that are nearly as large."""
    labels = connected_components(mask.voxels, corners=True)
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    if given is None:
        return labels, sizes, *_piece_on_side(mask, labels, sizes, vessel)
    return labels, sizes, _nearest_piece(mask, labels, sizes, given, label), []


def _cut_out(mask: Volume, voxels: Bool[np.ndarray, "nz ny nx"]) -> tuple[tuple[slice, slice, slice], Volume]:
    """Return the smallest box that holds some voxels of a mask, and these voxels alone as a mask of that box."""
    box = filled_box(voxels)
    corner = np.array([part.start for part in box][::-1], dtype=float)
    return box, replace(mask, voxels=voxels[box], origin_mm=mask.index_to_world(corner))


def _piece_at(mask: Volume, labels: np.ndarray, sizes: np.ndarray, place: Float[np.ndarray, "3"] | None) -> int:
    """Return the label of the piece at a place, 0 if there is none."""
    if place is None:
        return 0
    index = np.argwhere(labels > 0)
    index = index[sizes[labels[tuple(index.T)]] >= SMALLEST_PIECE]
    gap = np.linalg.norm(mask.index_to_world(index[:, ::-1].astype(float)) - place, axis=1)
    return int(labels[tuple(index[gap.argmin()])]) if len(gap) and gap.min() < NEAR_OSTIUM_MM else 0


def _left_out(
    mask: Volume, result: Bool[np.ndarray, "nz ny nx"], labels: np.ndarray, sizes: np.ndarray, foreign: int
) -> list[str]:
    """Say which pieces were left out and where they lie, since a real vessel may be lost with them.

    Args:
        mask: all pieces.
        result: the lumen.
        labels: number of each piece.
        sizes: their voxels, by number.
        foreign: number of a piece that belongs to another vessel, 0 if there is none.
    """
    kept = np.isin(np.arange(len(sizes)), labels[result])
    kept[[0, foreign]] = True
    lost = np.flatnonzero(~kept)
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
        box = boxes[lost[number] - 1]
        own = np.argwhere(labels[box] == lost[number]) + corners[number, :, 0]
        place = mask.index_to_world(own[:, ::-1].astype(float))
        gap = np.asarray(reach.query(place)[0])
        remarks.append(
            f"a piece apart from the lumen left out ({sizes[lost[number]]} voxels): it is {extent[number]:.0f} mm long "
            f"and begins {gap.min():.1f} mm away at {place_text(place[gap.argmin()])}; close the gap in the mask if it "
            "belongs to the vessel"
        )
    rest = order[len(remarks) :]
    if len(rest):
        kind = "more pieces" if remarks else "pieces apart from the lumen"
        longest, size = float(extent[rest].max()), int(sizes[lost[rest]].sum())
        remarks.append(f"{len(rest)} {kind} of up to {longest:.0f} mm left out ({size} voxels)")
    return remarks


def _bridged(
    result: Bool[np.ndarray, "nz ny nx"], labels: np.ndarray, pieces: list[int]
) -> tuple[Bool[np.ndarray, "nz ny nx"], int, int]:
    """Join pieces that lie within the largest gap by tubes as wide as the vessels at both ends.

    Returns the lumen, how many pieces were joined, and how many are near enough but run alongside it: two vessels that
    pass each other are not one.
    """
    if not pieces:
        return result, 0, 0
    result, joined, beside = result.copy(), 0, 0
    clearance: np.ndarray | None = None  # where nothing is joined it is not needed
    members = {piece: np.argwhere(labels == piece) for piece in pieces}
    changed = True
    while changed:
        changed = False
        here = np.argwhere(result)
        reach = KDTree(here)
        for piece in list(members):
            gap, nearest = map(np.asarray, reach.query(members[piece], distance_upper_bound=LARGEST_GAP_VOXELS))
            best = int(np.argmin(gap))
            if not np.isfinite(gap[best]):
                continue
            start, own = here[nearest[best]], members.pop(piece)
            end = own[best]
            if not (_carries_on(here, start, end) or _carries_on(own, end, start)):
                beside += 1
                continue
            if clearance is None:
                clearance = np.asarray(distance_transform_edt(labels > 0))
            width = min(_widest(clearance, start), _widest(clearance, end))
            _draw_tube(result, start, end, width)
            result |= labels == piece
            joined += 1
            changed = True
    return result, joined, beside


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
