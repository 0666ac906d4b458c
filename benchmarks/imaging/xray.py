"""Speed of X-ray images, and errors of tip detection and registration in new patients: `bench_xray`."""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, TypeVar

import numpy as np

from benchmarks.figures import Bar, judged
from benchmarks.imaging.scenes import Scene, SceneConfig, Signal, draw_scenes
from endopilot.anatomy.projection import project_tip
from endopilot.settings import Seed, Within, settings
from endopilot.simulation.motion import Motion, draw_motion, place, published_mean
from endopilot.types import Anatomy
from endopilot.xray.carm import Pose
from endopilot.xray.detector import DISPLACED_MM, TipDetector
from endopilot.xray.image import ImageConfig, isocenter_of
from endopilot.xray.image_fluoroscope import DRIFTS_MM
from endopilot.xray.registration import Registration, register, register_motion, take_run
from endopilot.xray.tip_posterior import TipEstimate

BARS = {
    "images_per_second": Bar(15.0, at_least=True),
    "tip_along_median_px": Bar(2.2),
    "tip_along_median_mm": Bar(1.0),
    "tip_across_median_px": Bar(0.5),
    "missed_share": Bar(0.02),
    "registration_error_mm": Bar(0.5),
    "registration_error_one_view_mm": Bar(1.0),
}
MISSED_PX = 10.0
"""A tip that is found farther than this from where it is, in any of the images, pixels, is missed as one not found."""
DOSES, CONTRASTS = (0.25, 1.0, 4.0), (0.0, 0.7)
_TIMED = 30
_NO_WIRE = 3
_REFINING = 4
"""Images of wires, each another, that refine a pose."""
_OVERLAP_PX = 6.0
_BONE = 0.25
"""A tip lies before bone or liver where the background takes away this much more than in the middle, in powers of e."""
_SEEN_SHARE = 0.5
SHOWN = ((0, 1), (0,), (1,))
"""Both views, and each alone."""
Case = tuple[int | None, float, float, tuple[int, ...]]
"""Of an exposure: the wire, the dose, the contrast, and the views."""
Row = TypeVar("Row", bound="Exposure")
_OF_95 = 2.795
"""Standard deviations within which 95 % of normally distributed errors in space lie."""


def view_text(angles_deg: Sequence[float]) -> str:
    """Return a view as clinics write it, such as "LAO 45 CRAN 20"."""
    lao, cranial = angles_deg
    side, tilt = ("LAO" if lao >= 0 else "RAO"), ("CRAN" if cranial >= 0 else "CAUD")
    return f"{side} {abs(lao):.0f}" + (f" {tilt} {abs(cranial):.0f}" if cranial else "")


@settings
class XrayBenchConfig:
    """Patients and images."""

    patients: Annotated[int, Within(1, 1000)] = 6
    """Synthetic patients, right and left coronary trees in turn; none has trained the detector."""
    wires: Annotated[int, Within(1, 1000)] = 8
    """Wires of each patient; each is exposed at the usual dose, with two views and with each alone."""
    seed: Seed = 1
    """Seed of patients, poses, wires and noise."""
    given: tuple[Path, ...] = ()
    """Folders of anatomies of your own in place of synthetic patients, as `endopilot anatomy` makes them."""
    image: ImageConfig = field(default_factory=ImageConfig)
    """Detector, beam and processing."""


@dataclass(frozen=True)
class Exposure:
    """One detection, or a miss.

    Attributes:
        views: how many images it had.
        dose: multiple of the usual dose.
        contrast: share of the full contrast.
        angle: of the first view, in words.
        wire: whether there was one.
        found: whether one was found.
        along_px, across_px: errors in the worse image, pixels.
        along_mm: error along the vessel, mm.
        space_mm: error in space, mm.
        deviations: the error in space over the detector's own standard deviation.
        overlaps: the tip lies over another branch in an image.
        bone: it lies over bone or liver.
        foreshortened: the wire's end points more along the beam than across it.
    """

    views: int
    dose: float
    contrast: float
    angle: str
    wire: bool
    found: bool
    along_px: float = np.nan
    across_px: float = np.nan
    along_mm: float = np.nan
    space_mm: float = np.nan
    deviations: float = np.nan
    overlaps: bool = False
    bone: bool = False
    foreshortened: bool = False

    @property
    def missed(self) -> bool:
        """Whether a wire was not found, or somewhere else."""
        return self.wire and not (self.found and np.hypot(self.along_px, self.across_px) <= MISSED_PX)


def bench_xray(config: XrayBenchConfig = XrayBenchConfig()) -> dict[str, Any]:
    """Measure how fast X-ray images are made, and how well tips and poses are found in them, in new patients.

    They lie in an unknown pose.

    Returns:
        The figures of `BARS` for two views at the usual dose without contrast, with their bars; `one_view` likewise;
        `by`: the same by dose, contrast, view, overlap, bone and foreshortening; `false_alarms_share`: images without a
        wire in which one is found; `inside_own_95_share`: tips within the ellipsoid that the detector
        is 95 % sure of; `registration`: every patient's errors, in `refined_mm` after
        each of some exposures of wires: in both views, in the registered view alone, and in the other alone;
        `motion_error_mm`: how far a vessel that heart and breath move lies from where a run of contrast has it, and
        `motion_error_of_published_mean_mm`, both medians of the patients.
    """
    exposures: list[Exposure] = []
    registrations: list[dict[str, Any]] = []
    rates: list[float] = []
    scenes = SceneConfig(patients=config.patients, seed=config.seed, given=config.given)
    for index, scene in enumerate(draw_scenes(scenes, config.image)):
        rates.append(_images_per_second(scene))
        registered, row = _register(scene, int(np.random.SeedSequence([config.seed, index]).generate_state(1)[0]))
        registrations.append(row)
        exposures += expose(scene, registered, cases_of(config.wires))
    return _figures(exposures, registrations, rates)


def _images_per_second(scene: Scene) -> float:
    """Return how many images of a moving wire are made in a second."""
    began = time.perf_counter()
    for index in range(_TIMED):
        at = index % len(scene.nodes)
        scene.imager.grey(
            scene.imager.signal(scene.planes[0], scene.nodes[at], velocity=scene.velocity[at], seed=index)
        )
    return _TIMED / (time.perf_counter() - began)


def _register(scene: Scene, seed: int) -> tuple[Registration, dict[str, Any]]:
    """Return the registration of two views, and the errors of it, of each view alone, and of a motion drawn so."""
    views = [scene.view(0), scene.view(1)]
    lit, before = scene.signals(None, contrast=1.0, seed=900_001), scene.signals(None, seed=900_002)
    both = register(scene.anatomy, views, lit, before)
    alone = [register(scene.anatomy, views[i : i + 1], lit[i : i + 1], before[i : i + 1]) for i in (0, 1)]
    refined = {
        "two_views": _refined(scene, both, (0, 1)),
        "one_view": [_refined(scene, one, (i,)) for i, one in enumerate(alone)],
        "other_view": [_refined(scene, one, (1 - i,)) for i, one in enumerate(alone)],
    }
    empty = register(scene.anatomy, views, scene.signals(None, seed=900_003), before)
    return both, {
        "patient": scene.anatomy.name,
        "before_mm": vessel_error_mm(scene.anatomy, scene.pose, Pose()),
        "two_views_mm": vessel_error_mm(scene.anatomy, scene.pose, both.pose),
        "one_view_mm": [vessel_error_mm(scene.anatomy, scene.pose, one.pose) for one in alone],
        "refined_mm": refined,
        "failures": sum(bool(one.failure) for one in (both, *alone)),
        "refused_without_contrast": bool(empty.failure),
        "motion_mm": _motion_errors(scene, both, before, seed),
    }


def _motion_errors(
    scene: Scene, registered: Registration, before: Sequence[Signal], seed: int
) -> dict[str, float | None]:
    """Return how far the vessel, moved by heart and breath, lies from where it is taken to lie, mm.

    Args:
        scene: the patient, whose motion is drawn.
        registered: of two views.
        before: images of both before the injection.
        seed: of the motion and the images' noise.

    Returns:
        The error of the published `mean`, and of the motion `measured` in a run of contrast; None where that failed.
    """
    motion = draw_motion(seed)
    mean = published_mean(motion)
    assert mean is not None
    run = take_run(scene.imager, scene.angles_deg, scene.pose, motion, np.random.default_rng(seed))
    views = registered.views([scene.view(0), scene.view(1)], scene.imager.isocenter)
    found = register_motion(scene.anatomy, views, run, before, mean, scene.imager.config)
    measured = None if found.failure or found.motion is None else motion_error_mm(scene.anatomy, motion, found.motion)
    return {"mean": motion_error_mm(scene.anatomy, motion, mean), "measured": measured}


def vessel_error_mm(anatomy: Anatomy, true: Pose, found: Pose) -> float:
    """Return how far a vessel in one pose lies from itself in another: the mean over its centerlines, mm."""
    points = anatomy.tree.line.points
    isocenter = isocenter_of(anatomy)
    return float(np.linalg.norm(true.move(points, isocenter) - found.move(points, isocenter), axis=1).mean())


def motion_error_mm(anatomy: Anatomy, true: Motion, taken: Motion) -> float:
    """Return how far a vessel that moves in one way lies from itself moving in another, mm.

    The mean is taken over its centerlines and over two breaths.
    """
    points = anatomy.tree.line.points
    ostium, times_s = np.asarray(anatomy.insertion.position), np.linspace(0, 2 * true.breathing_period_s, 49)
    lies, taken_to_lie = (
        np.stack([place(maps, points) for maps in one.core(ostium).placements(times_s)[0]]) for one in (true, taken)
    )
    return float(np.linalg.norm(lies - taken_to_lie, axis=-1).mean())


def _refined(scene: Scene, registered: Registration, used: Sequence[int]) -> list[float]:
    """Return the error of a registered pose, mm, after each of some exposures of wires in these views."""
    detector, shift = TipDetector(scene.anatomy, scene.device), np.zeros(3)
    spread = registered.place_covariance(scene.anatomy) + DISPLACED_MM**2 * np.eye(3)
    views, errors = registered.views([scene.view(i) for i in used], scene.imager.isocenter), []
    for wire in range(_REFINING):
        signals = scene.signals(wire, seed=910_000 + wire)
        found = detector.estimate(
            [replace(view, source=view.source - shift) for view in views],
            [signals[i] for i in used],
            [scene.imager.photons(scene.planes[i]) for i in used],
            float(scene.inserted_length[wire]),
            displaced=spread,
        )
        if found.status == "found":
            shift, spread = shift + found.shift, found.spread[3:, 3:] + DRIFTS_MM**2 * np.eye(3)
        pose = Pose(registered.pose.rotation_rad, registered.pose.translation_mm + shift)
        errors.append(vessel_error_mm(scene.anatomy, scene.pose, pose))
    return errors


def cases_of(wires: int) -> list[Case]:
    """Return the exposures of some wires: at the usual dose in both views and in each alone; and others in both."""
    usual: list[Case] = [(wire, 1.0, 0.0, used) for wire in range(wires) for used in SHOWN]
    other: list[Case] = [
        (wire, dose, contrast, (0, 1))
        for wire, dose, contrast in itertools.product(range(0, wires, 2), DOSES, CONTRASTS)
        if (dose, contrast) != (1.0, 0.0)
    ]
    absent: list[Case] = [
        (None, dose, contrast, used) for dose in DOSES for contrast in CONTRASTS for used in SHOWN[:2]
    ]
    return usual + other + absent * _NO_WIRE


def expose(scene: Scene, registered: Registration, cases: Sequence[Case]) -> list[Exposure]:
    """Return what the detector finds in some exposures.

    Args:
        scene: the patient.
        registered: of two views.
        cases: of each exposure the wire, or none, the dose, the contrast and the views.
    """
    detector, rows = TipDetector(scene.anatomy, scene.device), []
    views = registered.views([scene.view(0), scene.view(1)], scene.imager.isocenter)
    before = scene.signals(None, seed=900_002)
    for index, (wire, dose, contrast, used) in enumerate(cases):
        number = index % len(scene.nodes) if wire is None else wire
        signals = scene.signals(wire, contrast=contrast, dose=dose, seed=index)
        photons = [scene.imager.photons(plane, dose) for plane in scene.planes]
        found = detector.estimate(
            [views[i] for i in used],
            [signals[i] for i in used],
            [photons[i] for i in used],
            float(scene.inserted_length[number]),
            [detector.lines(views[i], before[i], photons[i]) for i in used],
        )
        angle = scene.angles_deg[used[0]]
        row = Exposure(len(used), dose, contrast, view_text(angle), wire is not None, found.status != "not found")
        rows.append(row if wire is None else errors_of(row, scene, wire, used, found))
    return rows


def errors_of(row: Row, scene: Scene, wire: int, used: Sequence[int], found: TipEstimate) -> Row:
    """Return a row with what is special about the tip, and with its errors."""
    nodes = scene.nodes[wire]
    tip, direction = nodes[0], (nodes[0] - nodes[1]) / np.linalg.norm(nodes[0] - nodes[1])
    true = project_tip(scene.anatomy.tree, scene.anatomy.insertion, tip[None])
    others = [b.centerline for i, b in enumerate(scene.anatomy.tree.branches) if i != int(true.branch[0])]
    overlaps = bone = foreshortened = False
    along, across = [0.0], [0.0]
    for index in used:
        plane = scene.planes[index]
        pixel, slope = plane.view.project(tip), plane.view.slope(tip) @ direction
        seen = float(np.linalg.norm(slope))
        foreshortened |= seen < _SEEN_SHARE * float(np.linalg.norm(plane.view.slope(tip), 2))
        far = [line.points[np.linalg.norm(line.points - tip, axis=1) > 6.0] for line in others]
        overlaps |= any(
            len(points) and np.linalg.norm(plane.view.project(points) - pixel, axis=1).min() < _OVERLAP_PX
            for points in far
        )
        place = np.clip(np.rint(plane.pixel(tip)).astype(int), 0, len(plane.background) - 1)
        bone |= bool(plane.background[tuple(place)] > np.median(plane.background) + _BONE)
        if not row.found:
            continue
        axis = slope / max(seen, 1e-9)
        error = plane.view.project(found.position) - pixel
        along.append(abs(float(error @ axis)))
        across.append(abs(float(error @ np.array([-axis[1], axis[0]]))))
    special = replace(row, overlaps=overlaps, bone=bone, foreshortened=foreshortened)
    if not row.found:
        return special
    shown = project_tip(scene.anatomy.tree, scene.anatomy.insertion, found.position[None])
    error = found.position - tip
    return replace(
        special,
        along_px=max(along),
        across_px=max(across),
        along_mm=abs(float(shown.abscissa[0] - true.abscissa[0])),
        space_mm=float(np.linalg.norm(error)),
        deviations=float(np.sqrt(error @ np.linalg.solve(found.covariance, error))),
    )


def _figures(exposures: list[Exposure], registrations: list[dict[str, Any]], rates: list[float]) -> dict[str, Any]:
    def usual(one: Exposure) -> bool:
        return one.wire and one.dose == 1.0 and one.contrast == 0.0

    two = [one for one in exposures if usual(one) and one.views == 2]
    single = [one for one in exposures if usual(one) and one.views == 1]
    without = [one for one in exposures if not one.wire]
    by = {
        f"dose {dose:g}, contrast {contrast:g}": summary(
            one for one in exposures if one.wire and one.views == 2 and (one.dose, one.contrast) == (dose, contrast)
        )
        for dose, contrast in itertools.product(DOSES, CONTRASTS)
    }
    by |= {f"{angle} alone": summary(one for one in single if one.angle == angle) for angle in _angles(single)}
    for name, of in (
        ("over another branch", "overlaps"),
        ("over bone or liver", "bone"),
        ("the end along the beam", "foreshortened"),
    ):
        by[f"one view, {name}"] = summary(one for one in single if getattr(one, of))
    figures = {
        "images_per_second": float(np.median(rates)),
        **summary(two),
        "registration_error_mm": float(np.median([row["two_views_mm"] for row in registrations])),
        "registration_error_one_view_mm": float(np.median([row["one_view_mm"] for row in registrations])),
        **_motion_summary([row["motion_mm"] for row in registrations]),
        "false_alarms_share": float(np.mean([one.found for one in without])),
        "one_view": summary(single),
        "by": by,
        "registration": registrations,
    }
    return judged(figures, BARS)


def _motion_summary(errors: list[dict[str, float | None]]) -> dict[str, Any]:
    measured = [one["measured"] for one in errors if one["measured"] is not None]
    return {
        "motion_error_mm": float(np.median(measured)) if measured else None,
        "motion_error_of_published_mean_mm": float(
            np.median([one["mean"] for one in errors if one["mean"] is not None])
        ),
        "motions_not_measured": len(errors) - len(measured),
    }


def _angles(exposures: list[Exposure]) -> list[str]:
    return sorted({one.angle for one in exposures})


def summary(exposures: Iterable[Exposure]) -> dict[str, Any]:
    """Return errors, misses and calibration of some exposures of a wire."""
    rows = list(exposures)
    found = [one for one in rows if one.found]

    def median(name: str) -> float:
        return float(np.median([getattr(one, name) for one in found])) if found else float("nan")

    return {
        "tip_along_median_px": median("along_px"),
        "tip_across_median_px": median("across_px"),
        "tip_along_median_mm": median("along_mm"),
        "tip_in_space_median_mm": median("space_mm"),
        "tip_in_space_p95_mm": float(np.percentile([one.space_mm for one in found], 95)) if found else float("nan"),
        "missed_share": float(np.mean([one.missed for one in rows])) if rows else float("nan"),
        "inside_own_95_share": float(np.mean([one.deviations <= _OF_95 for one in found])) if found else 0.0,
        "images": len(rows),
    }
