"""The tip of a wire in X-ray images of one's own: registered from contrast, detected, and followed over the frames.

The frame that shows the vessel best registers the patient, and every other frame with contrast lays the vessel anew,
since heart and breath move it; a frame without takes the nearest one's. In each frame the detector says how likely the
wire ends at each place of the tree; what the other frames say of these places, and how far a tip travels in the time
between, is the prior of the frame.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from jaxtyping import Bool, Float, Float32
from scipy.ndimage import gaussian_filter

from endopilot.anatomy.projection import TipProjector
from endopilot.devices.device import Wire
from endopilot.errors import InputError
from endopilot.progress import progress
from endopilot.types import Anatomy
from endopilot.xray.carm import Image, Places, Pose, View, view_of
from endopilot.xray.cine import XrayCine
from endopilot.xray.detector import Exposure, TipDetector, own_share
from endopilot.xray.image import isocenter_of
from endopilot.xray.line_observations import shift_onto
from endopilot.xray.registration import Registration, lay, observed_contrast, register
from endopilot.xray.tip_filter import TipLocation, located
from endopilot.xray.tip_posterior import LocateConfig, TipEstimate, VesselGrid

_EMPTY_SHARE = 0.9
"""A pixel's light where no contrast passes is this quantile of the frames': contrast and wire darken fewer."""
_DARKEST_SHARE = 0.05
"""This share of an image, the darkest, tells how much contrast a frame shows: vessels cover no less."""
_SURROUNDINGS_PX = 6.0
"""Contrast is seen in the mean around a pixel, standard deviation, pixels."""
_CLEAR = 0.2
"""Ridges are as large as the noise where this is the own share of what is seen (2 / 11)."""
_LESS = 0.06
"""They do where image and vessel agree within this of the best frame's correlation."""
_SOME = 0.4
"""Frames with this share of the most contrast lay the vessel by themselves."""
_MOVES_MM = 2.5
"""How far heart and breath move a vessel from where a landmark or another frame registers it, along each axis: standard
deviation, mm, of the size of the published amplitudes (docs/concepts/motion.md)."""
_FEWEST, _STIRS_MM = 4, 1.0
"""From so many frames on, how far their vessels lie apart says how far it moves; and by how much more at least, mm."""
_ELSEWHERE_MM = 4.0
"""A tip this far from where all frames together have it is sought anew."""
_OTHERWISE = (
    "PositionerPrimaryAngle has the other sign (RAO, LAO)",
    "PositionerSecondaryAngle has the other sign (cranial, caudal)",
    "the image is mirrored left to right",
)
_FRAME_S = 0.133
"""Time of a frame at which `LocateConfig.travel_mm` is meant, s: 7.5 frames a second, usual in fluoroscopy."""


@dataclass(frozen=True, eq=False)
class ImagesLocated:
    """What was found in cines of one patient.

    Attributes:
        tips: of each frame.
        wires: the wire in each, from the catheter to its tip, LPS mm of the CT; None where none is found.
        views: of each frame and plane, in the CT's frame, as the vessel lies then.
        cines: as they fit the vessel.
        registration: of the frame that shows the vessel best; None where a landmark registered the patient.
        best: index of that frame.
        notes: what was assumed, or changed.
    """

    tips: tuple[TipLocation, ...]
    wires: tuple[Float[np.ndarray, "_ 3"] | None, ...]
    views: tuple[tuple[View, ...], ...]
    cines: tuple[XrayCine, ...]
    registration: Registration | None
    best: int
    notes: tuple[str, ...]

    def pixels(self, frame: int, points: Places) -> Float[np.ndarray, "n 2"]:
        """Return column and row, pixels of the first plane, of points of the vessel or in it, LPS mm of the CT."""
        return self.views[frame][0].pixel(points, self.cines[0].signals.shape[1])[:, ::-1]


def locate_in_images(
    anatomy: Anatomy, *, cines: Sequence[XrayCine], device: Wire, config: LocateConfig | None = None
) -> ImagesLocated:
    """Find the tip of a wire in each frame of a cine, or of two planes that were exposed together; `config` has a
    landmark, where no contrast registers the patient, and how far the tip travels. Raises InputError for planes of
    different numbers of frames, or where nothing registers the patient."""
    config, count = config or LocateConfig(), len(cines[0].times_s)
    for one in cines[1:]:
        if len(one.times_s) != count:
            raise InputError(f"{one.path}: {len(one.times_s)} frames, and {count} in {cines[0].path}; give one pair")
        if one.image != cines[0].image:
            raise InputError(f"{one.path}: has another geometry or size than {cines[0].path}; give two planes alike")
    cines, laid, known, best, notes = _registered(anatomy, tuple(cines), config)
    isocenter = isocenter_of(anatomy)
    views = [[view_of(one.view(isocenter), pose, isocenter) for one in cines] for pose, _ in laid]
    detector, photons = TipDetector(anatomy, device), [one.photons() for one in cines]
    planes = [_darkened(one.signals, _empty(one), one.field()) for one in cines]
    dark, seen = list(zip(*planes, strict=True)), list[Exposure]()
    with progress(f"locate {anatomy.name}", count) as advance:
        for frame, (_, spread) in enumerate(laid):
            shown = [one.signals[frame] for one in cines]
            seen.append(detector.look(views[frame], shown, photons, (), spread, dark[frame]))
            advance()
    clear = [_is_clear(detector.grid, *each, photons) for each in zip(views, dark, strict=True)]
    found = _followed(detector, seen, clear, cines[0].times_s, config)
    project, tips = TipProjector(anatomy.tree, anatomy.insertion), []
    for frame, one in enumerate(found):
        # Where heart and breath have taken the vessel is a guess in frames without contrast: no tip is sure there.
        if frame not in known and one.status == "found":
            one = replace(one, status="ambiguous")
        views[frame] = [replace(view, source=view.source - one.shift) for view in views[frame]]
        moved = laid[frame][0].move(one.position + one.shift, isocenter) - one.position
        at = project(one.position[None])
        place = int(at.branch[0]), float(at.abscissa[0])
        tips.append(located(anatomy.tree, frame, one, place, moved_mm=moved, residual_mm=np.nan))
    return ImagesLocated(
        tips=tuple(tips),
        wires=tuple(None if one.status == "not found" else one.wire for one in found),
        views=tuple(map(tuple, views)),
        cines=cines,
        registration=known.get(best),
        best=best,
        notes=notes,
    )


_Laid = list[tuple[Pose, Float[np.ndarray, "3 3"]]]
"""How the patient lies in each frame, and the covariance of how far the vessel lies off, mm²."""


def _registered(
    anatomy: Anatomy, cines: tuple[XrayCine, ...], config: LocateConfig
) -> tuple[tuple[XrayCine, ...], _Laid, dict[int, Registration], int, tuple[str, ...]]:
    """Return the cines as they fit the vessel, how it lies in each frame, frames that show it, the best one, and notes.
    Raises InputError where nothing registers the patient."""
    notes = tuple(f"{one.path.name}: {note}" for one in cines for note in one.notes)
    count, isocenter = len(cines[0].times_s), isocenter_of(anatomy)
    if config.landmark_mm is not None:
        if config.landmark_px is None:
            raise InputError("landmark_px: missing; give the pixel of the first frame that shows landmark_mm")
        pixel = (np.array(config.landmark_px) - (cines[0].signals.shape[1] - 1) / 2) * [1, -1]
        shift = shift_onto(cines[0].view(isocenter), np.array(config.landmark_mm), pixel)
        return cines, [(Pose(translation_mm=shift), _MOVES_MM**2 * np.eye(3))] * count, {}, 0, notes
    before = [_empty(one) for one in cines]
    contrast = np.sum([_contrast(one, empty) for one, empty in zip(cines, before, strict=True)], axis=0)
    best = int(contrast.argmax())
    tried: list[tuple[Registration, tuple[XrayCine, ...], list[np.ndarray], str]] = []
    for seen, empty, said in _read_otherwise(cines, before):
        views, lit = [one.view(isocenter) for one in seen], [one.signals[best] for one in seen]
        start = lay(anatomy, views, lit, empty, seen[0].image)
        tried.append((register(anatomy, views, lit, empty, seen[0].image, start), seen, empty, said))
        if not tried[-1][0].failure:
            break
    first, cines, before, said = max(tried, key=lambda one: one[0].correlation)
    if first.failure:
        raise InputError(
            f"{cines[0].path}: {anatomy.name} cannot be registered in frame {best}, whatever the angles' signs: "
            f"{tried[0][0].failure}; or give --landmark-mm and --landmark-px"
        )
    views, known = [one.view(isocenter) for one in cines], {best: first}
    for frame in sorted(range(count), key=lambda one: (one < best, abs(one - best))):
        if frame != best and contrast[frame] > _SOME * contrast[best]:
            near = min(known, key=lambda one: abs(one - frame))
            lit = [one.signals[frame] for one in cines]
            laid = register(anatomy, views, lit, before, cines[0].image, known[near].pose)
            known |= {} if laid.failure else {frame: laid}
    most = max(one.correlation for one in known.values())
    known = {frame: one for frame, one in known.items() if one.correlation > most - _LESS}
    # Where a frame shows no contrast, the vessel lies as far from its mean place as in those that do.
    points, stirs = anatomy.tree.line.points[::8], _STIRS_MM**2 * np.eye(3)
    lies = np.array([one.pose.move(points, isocenter) for one in known.values()])
    off = lies - lies.mean(axis=0)
    spread = np.einsum("kni,knj->ij", off, off) / off[..., 0].size + stirs
    spread += max(_FEWEST - len(known), 0) / _FEWEST * _MOVES_MM**2 * np.eye(3)
    mean = Pose.of_vector(np.mean([one.pose.vector for one in known.values()], axis=0))
    laid = [(known[frame].pose, stirs) if frame in known else (mean, spread) for frame in range(count)]
    best = max(known, key=lambda one: known[one].correlation)
    return cines, laid, known, best, (*notes, *([said] if said else []))


def _empty(cine: XrayCine) -> Image:
    """Return the light without contrast."""
    return np.quantile(cine.signals, _EMPTY_SHARE, axis=0).astype(np.float32)


def _darkened(
    shown: Float32[np.ndarray, "frames rows rows"], empty: Image, field: Bool[np.ndarray, "rows rows"]
) -> list[Image]:
    """Return how much darker than without contrast the surroundings of each pixel are: a wire darkens them little.
    Where nothing is seen anything may be, contrast without bound."""
    dark = [gaussian_filter(empty - one, _SURROUNDINGS_PX) for one in shown]
    return [np.where(field, np.maximum(one - np.median(one[field]), 0), np.float32(np.inf)) for one in dark]


def _is_clear(grid: VesselGrid, views: Sequence[View], dark: Sequence[Image], photons: Sequence[float]) -> bool:
    """Return whether nearly no part of the vessel has contrast whose ridges are as large as the noise."""
    own = []
    for view, each, count in zip(views, dark, photons, strict=True):
        row, column = np.rint(view.pixel(grid.middle, len(each))).astype(int).T
        seen = (np.minimum(row, column) >= 0) & (np.maximum(row, column) < len(each))
        own.append(own_share(each[row[seen], column[seen]], count))
    told = np.concatenate(own)
    return bool((told[told > 0] < _CLEAR).mean() < _DARKEST_SHARE) if (told > 0).any() else False


def _contrast(cine: XrayCine, before: Float32[np.ndarray, "rows rows"]) -> Float[np.ndarray, "frames"]:
    """Return how much contrast each frame shows, in powers of e."""
    seen = [observed_contrast([one], [before], 8, 3.0, cine.image)[0].ravel() for one in cine.signals]
    return np.array([np.sort(one)[-round(_DARKEST_SHARE * len(one)) :].mean() - np.median(one) for one in seen])


def _read_otherwise(
    cines: tuple[XrayCine, ...], before: list[np.ndarray]
) -> Iterator[tuple[tuple[XrayCine, ...], list[np.ndarray], str]]:
    """Yield the cines as their files have them, then with angles of other signs and mirrored, and say so."""
    for mirrored, first, second in product((False, True), (1, -1), (1, -1)):
        if any(one.camera.angles_deg is None for one in cines) and (first, second) != (1, 1):
            continue
        changes = [what for what, so in zip(_OTHERWISE, (first < 0, second < 0, mirrored), strict=True) if so]
        said = f"the vessel fits the images only if {' and '.join(changes)}; taken so" if changes else ""
        seen = []
        for one in cines:
            angles = one.camera.angles_deg
            turned = None if angles is None else (first * angles[0], second * angles[1])
            signals = one.signals[..., ::-1] if mirrored else one.signals
            seen.append(replace(one, signals=signals, camera=replace(one.camera, angles_deg=turned)))
        yield tuple(seen), [empty[:, ::-1] if mirrored else empty for empty in before], said


def _followed(
    detector: TipDetector,
    seen: Sequence[Exposure],
    clear: Sequence[bool],
    times_s: Float[np.ndarray, "frames"],
    travel: LocateConfig,
) -> list[TipEstimate]:
    """Return where the tip is in each frame: by itself, and where that is nothing or elsewhere, by all frames.

    Contrast looks alike in all frames that show it, however many there are: those that are not `clear` of it say
    nothing of others. What looks like a wire and is none does so in all frames: of whether there is one, they say no
    more than the clearest.
    """
    grid = detector.grid
    anywhere = np.where(grid.branch < 0, -np.inf, 0.0)
    told = [detector.tell(one, anywhere) for one in seen]
    found = [detector.judge(one, said, anywhere, odds) for one, (said, odds) in zip(seen, told, strict=True)]
    tells = [sees and one.status != "not found" for sees, one in zip(clear, found, strict=True)]
    said = [one._replace(log=anywhere + (one.log if own else 0.0)) for own, (one, _) in zip(tells, told, strict=True)]
    frames = np.maximum(np.diff(times_s), 1e-3) / _FRAME_S
    later = grid.told_by_later(travel, said, frames)
    before = grid.told_by_later(travel, said[::-1], frames[::-1])[::-1]
    odds = np.where(tells, [one.log_odds for one in found], 0.0)
    for k, one in enumerate(seen):
        others = anywhere + later[k] + before[k]
        place = grid.middle[(said[k].log + others).argmax()]
        if found[k].status == "not found" or np.linalg.norm(found[k].position - place) > _ELSEWHERE_MM:
            again, own = detector.tell(one, others)
            found[k] = detector.judge(one, again, others, own + float(np.delete(odds, k).max(initial=0.0)))
            if found[k].status == "found" and np.linalg.norm(found[k].position - place) > _ELSEWHERE_MM:
                found[k] = replace(found[k], status="ambiguous")
    return found
