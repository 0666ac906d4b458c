"""Wires found wherever they lie, and what the detector says where it is wrong: `bench_wires`."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from jaxtyping import Float

from benchmarks.figures import Bar, judged
from benchmarks.imaging.scenes import Scene, SceneConfig, draw_scene
from benchmarks.imaging.xray import SHOWN, Exposure, errors_of, summary, view_text
from endopilot.anatomy.projection import project_tip
from endopilot.files import read_json, write_json
from endopilot.runs import OutputFolder, claim
from endopilot.settings import NonNegative, Seed, Within, settings
from endopilot.simulation.motion import place
from endopilot.types import Anatomy
from endopilot.xray.absorbers import wire_points
from endopilot.xray.detector import TipDetector
from endopilot.xray.image import ImageConfig, Plane
from endopilot.xray.projector import Shadow
from endopilot.xray.registration import register

ANGLES = (((-30.0, 0.0), (60.0, 0.0)), ((-20.0, 25.0), (45.0, 20.0)), ((0.0, -30.0), (90.0, 0.0)))
"""Pairs of views of each patient, LAO (positive) or RAO and cranial (positive) or caudal, degrees."""
DOSES = (1.0, 0.5, 2.0)
"""Multiples of the usual dose, which the wires take in turn."""
BARS = {
    "missed_share": Bar(0.03),
    "missed_share_one_view": Bar(0.10),
    "said_share": Bar(0.9, at_least=True),
    "inside_own_95_share": Bar(0.92, at_least=True),
    "false_alarms_share": Bar(0.0),
    "ms_a_view": Bar(50.0),
}
FOLDED_MM = 1.0
"""A wire is folded where its tip lies this much less deep than another place of it, mm along the vessel."""
_LEAD_MM, _LEAD_RADIUS_MM = 160.0, 0.35
_CLIPS, _CLIP_MM, _CLIP_RADIUS_MM, _LOOPS, _LOOP_MM, _LOOP_RADIUS_MM = 6, 6.0, 0.5, 3, 14.0, 0.4
"""Metal beside the wire, of assumed sizes: the coiled conductor of a pacemaker's lead, surgical clips, and loops of
steel around the sternum."""
_METAL_PX = 1.5
"""Standard deviation of the metal's width and blur in the image, pixels."""


@settings
class WiresConfig:
    """Patients and wires."""

    given: tuple[Path, ...] = ()
    """Folders of anatomies, as `endopilot anatomy` makes them, in place of synthetic patients."""
    patients: Annotated[int, Within(1, 1000)] = 2
    """Synthetic patients, right and left coronary trees in turn; `given` goes before them."""
    wires: Annotated[int, Within(1, 1000)] = 4
    """Wires of random navigations in each patient and pair of views; every other lies among other metal."""
    seed: Seed = 1
    """Seed of patients, poses, wires, metal and noise."""
    registration_off_mm: NonNegative = 0.0
    """How far the registered vessel is displaced, each pair of views in a direction of its own, mm."""
    image: ImageConfig = field(default_factory=ImageConfig)
    """Detector, beam and processing."""


@dataclass(frozen=True)
class Search(Exposure):
    """What the detector says of one exposure.

    Attributes:
        said: the detector's status.
        metal: whether other metal lies in the images.
        folded_mm: how much less deep the tip lies than another place of the wire, mm.
        patient: name of the anatomy.
        ms_a_view: processor time of the detection over the number of views, ms.
        log_odds, share: of `TipEstimate`.
    """

    said: str = "found"
    metal: bool = False
    folded_mm: float = 0.0
    patient: str = ""
    ms_a_view: float = np.nan
    log_odds: float = np.nan
    share: float = np.nan


def bench_wires(
    *, output: OutputFolder = Path("runs/bench-wires"), config: WiresConfig = WiresConfig()
) -> dict[str, Any]:
    """Measure how often the tip detector misses wires, folded ones and loops among them, and whether it says so.

    Wires of random navigations are exposed from three pairs of angles, at half, once and twice the usual dose, in both
    views and in each alone; every other among a pacemaker's lead, clips and sternal wires. A patient whose file is in
    the output folder is not measured again, and more may be given later, after those.

    Args:
        output: folder that takes a file of each patient's exposures.
        config: patients and wires.

    Returns:
        Figures with bars: shares of missed wires; `said_share`: of the missed wires, and of those found where there is
        none, those that the detector calls ambiguous or does not find; `doubted_share`: of the others, those that it
        does not call found; `surely_wrong_share`: of all wires, those called found and missed; `inside_own_95_share`:
        of the wires called found, those whose tip is within the region that the detector is 95 % sure of, and the same
        of two views; `ms_a_view`: processor time, median. `by`: the same of some of the exposures.

    Raises:
        InputError: a folder holds no anatomy, or the output belongs to another run.
    """
    off = {"registration_off_mm": config.registration_off_mm} if config.registration_off_mm else {}
    claim(output, "benchmarks xray-wires", wires=config.wires, seed=config.seed, image=config.image, **off)
    rows: list[Search] = []
    scenes = SceneConfig(patients=config.patients, seed=config.seed, given=config.given)
    for index in range(len(config.given) or config.patients):
        name = config.given[index].name if config.given else "synthetic"
        path = output / f"{index:03d}-{name}.json"
        if not path.exists():
            write_json(path, list(_searches(draw_scene(scenes, index, config.image), config)))
        rows += [Search(**row) for row in read_json(path)]
    return figures_of(rows)


def _searches(scene: Scene, config: WiresConfig) -> Iterator[Search]:
    """Yield what the detector says of one patient's exposures."""
    metal = metal_points(scene.anatomy, np.random.default_rng([config.seed, 0x6D6574]))
    detector = TipDetector(scene.anatomy, scene.device)
    for pair, angles in enumerate(ANGLES):
        planes = tuple(scene.imager.plane(angle, pose=scene.pose) for angle in angles)
        seen = replace(scene, angles_deg=angles, planes=planes)
        lit, before = seen.signals(None, contrast=1.0, seed=900_001), seen.signals(None, seed=900_002)
        registered = register(seen.anatomy, [seen.view(0), seen.view(1)], lit, before)
        views = registered.views([seen.view(0), seen.view(1)], seen.imager.isocenter)
        off = np.random.default_rng([config.seed, pair, 0x6F6666]).standard_normal(3)
        off *= config.registration_off_mm / np.linalg.norm(off)
        views = [replace(view, source=view.source + off) for view in views]
        among = replace(seen, planes=tuple(with_metal(plane, *metal) for plane in planes))
        masks = before, among.signals(None, seed=900_004)
        wires: list[int | None] = [*range(pair * config.wires, (pair + 1) * config.wires), None, None]
        for number, wire in enumerate(wires):
            shown = among if number % 2 else seen
            at = number if wire is None else wire % len(scene.nodes)
            dose = DOSES[(number // 2 + pair) % len(DOSES)]
            signals = shown.signals(None if wire is None else at, dose=dose, seed=1000 * pair + number)
            photons = [scene.imager.photons(plane, dose) for plane in planes]
            lines = list(map(detector.lines, views, masks[number % 2], photons))
            for used in SHOWN:
                began = time.process_time()
                found = detector.estimate(
                    [views[i] for i in used],
                    [signals[i] for i in used],
                    [photons[i] for i in used],
                    float(scene.inserted_length[at]),
                    [lines[i] for i in used],
                )
                ms = 1000 * (time.process_time() - began) / len(used)
                row = Search(
                    views=len(used),
                    dose=dose,
                    contrast=0.0,
                    angle=view_text(angles[used[0]]),
                    wire=wire is not None,
                    found=found.status != "not found",
                    said=found.status,
                    metal=shown is among,
                    folded_mm=0.0 if wire is None else _folded_mm(scene, at),
                    patient=scene.anatomy.name,
                    ms_a_view=ms,
                    log_odds=found.log_odds,
                    share=found.share,
                )
                yield row if wire is None else errors_of(row, shown, at, used, found)


def _folded_mm(scene: Scene, wire: int) -> float:
    """Return how much less deep the tip of a wire lies than another place of it, mm."""
    depth = project_tip(scene.anatomy.tree, scene.anatomy.insertion, scene.nodes[wire]).abscissa
    return float(depth.max() - depth[0])


def metal_points(
    anatomy: Anatomy, random: np.random.Generator
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n"]]:
    """Return metal around a vessel as small volumes: places, LPS mm, and sizes times attenuation, mm²."""
    vessel = np.concatenate([branch.centerline.points for branch in anatomy.tree.branches])
    middle, turn = vessel.mean(axis=0), np.linspace(0, 2 * np.pi, 40)
    along = np.linspace(-0.5, 0.5, 60)[:, None]
    way, bend = (axis / np.linalg.norm(axis) for axis in random.standard_normal((2, 3)))
    lead = middle + random.uniform(-10, 10, 3) + _LEAD_MM * (along * way + along**2 * bend)
    parts = [(lead, _LEAD_RADIUS_MM)]
    for near in vessel[random.integers(len(vessel), size=_CLIPS)]:
        half = random.standard_normal(3)
        half *= 0.5 * _CLIP_MM / np.linalg.norm(half)
        at = near + random.uniform(-15, 15, 3)
        parts.append((np.stack([at - half, at + half]), _CLIP_RADIUS_MM))
    for number in range(_LOOPS):
        ring = _LOOP_MM * np.stack([np.cos(turn), 0.4 * np.sin(turn), np.sin(turn)], axis=-1)
        parts.append((middle + ring + [random.uniform(-20, 20), -70.0, 30.0 * (number - 1)], _LOOP_RADIUS_MM))
    points, sizes = zip(*(wire_points(line, radius, 0.0) for line, radius in parts), strict=True)
    return np.concatenate(points), np.concatenate(sizes)


def with_metal(plane: Plane, points: Float[np.ndarray, "n 3"], sizes: Float[np.ndarray, "n"]) -> Plane:
    """Return what does not move in a view, with metal of `metal_points`."""
    pixels = len(plane.background)
    shadow = Shadow(plane.view, pixels, place(plane.placed, points)).of(sizes, blur_px=_METAL_PX * plane.zoom)
    return replace(plane, background=plane.background + shadow)


def figures_of(rows: Sequence[Search]) -> dict[str, Any]:
    """Return figures of all exposures with their bars, and of some of them."""
    parts: dict[str, Callable[[Search], bool]] = {
        **{name: lambda row, name=name: row.patient == name for name in dict.fromkeys(row.patient for row in rows)},
        "without metal": lambda row: not row.metal,
        "among metal": lambda row: row.metal,
        "folded": lambda row: row.folded_mm > FOLDED_MM,
        "not folded": lambda row: row.folded_mm <= FOLDED_MM,
        **{f"dose {dose:g}": lambda row, dose=dose: row.dose == dose for dose in DOSES},
        **{view_text(pair[0]): lambda row, angle=view_text(pair[0]): row.angle == angle for pair in ANGLES},
    }
    whole = _shares(rows)
    return judged(whole, BARS) | {
        "by": {name: _shares([row for row in rows if kept(row)]) for name, kept in parts.items()}
    }


def _shares(rows: Sequence[Search]) -> dict[str, Any]:
    """Return the figures of some exposures."""
    wires, none = [row for row in rows if row.wire], [row for row in rows if not row.wire]
    two, one = ([row for row in wires if row.views == views] for views in (2, 1))
    wrong = [row for row in wires if row.missed] + [row for row in none if row.found]
    right = [row for row in wires if not row.missed]
    sure = [row for row in wires if row.said == "found"]

    def share(which: Sequence[Search], of: Callable[[Search], bool]) -> float:
        return float(np.mean([of(row) for row in which])) if which else float("nan")

    pairs = [row for row in sure if row.views == 2]
    return {
        "missed_share": share(two, lambda row: row.missed),
        "missed_share_one_view": share(one, lambda row: row.missed),
        "wires": len(two),
        "said_share": share(wrong, lambda row: row.said != "found"),
        "wrong": len(wrong),
        "doubted_share": share(right, lambda row: row.said != "found"),
        "surely_wrong_share": share(wires, lambda row: row.missed and row.said == "found"),
        "inside_own_95_share": summary(sure)["inside_own_95_share"] if sure else float("nan"),
        "inside_own_95_share_two_views": summary(pairs)["inside_own_95_share"] if pairs else float("nan"),
        "false_alarms_share": share(none, lambda row: row.found),
        "ms_a_view": float(np.median([row.ms_a_view for row in rows])) if rows else float("nan"),
    }
