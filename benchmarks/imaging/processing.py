"""How far detection and registration fall in images that the detector was not made for: `compare_processing`."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import replace
from typing import Any

import numpy as np

from benchmarks.imaging.scenes import SceneConfig, draw_scenes
from benchmarks.imaging.xray import SHOWN, Case, Exposure, XrayBenchConfig, expose, summary, vessel_error_mm
from endopilot.xray.image import XrayImager
from endopilot.xray.registration import register

CHANGES: dict[str, dict[str, float]] = {
    "as the detector was trained": {},
    "edges enhanced": {"edge_weight": 1.0},
    "temporal filter": {"temporal_weight": 0.5},
    "noise of electronics": {"electronic_noise_ugy": 0.01},
    "all of these": {"edge_weight": 1.0, "temporal_weight": 0.5, "electronic_noise_ugy": 0.01},
    "another detector": {"scintillator_mm": 0.24, "efficiency": 0.55, "scatter": 0.6, "focal_spot_mm": 1.0},
}
"""What differs in the images from those that the detector was trained on; how much is an assumption."""


def compare_processing(config: XrayBenchConfig = XrayBenchConfig(patients=2, wires=4)) -> list[dict[str, Any]]:
    """Measure tip detection and registration in processed images, and in those of another detector.

    Args:
        config: patients and wires, the same in every row.

    Returns:
        A row for each kind of image, at the usual dose without contrast: errors with two views (medians), the share of
        missed tips with two views and with one, of tips in the detector's own 95 % region with two, of images without
        a wire in which one is found, and the error of registration (median of the patients).
    """
    cases: list[Case] = [(wire, 1.0, 0.0, used) for wire in range(config.wires) for used in SHOWN]
    cases += [(None, 1.0, 0.0, used) for used in SHOWN]
    exposures: dict[str, list[Exposure]] = defaultdict(list)
    errors: dict[str, list[float]] = defaultdict(list)
    scenes = SceneConfig(patients=config.patients, seed=config.seed, given=config.given)
    for scene in draw_scenes(scenes, config.image):
        for name, change in CHANGES.items():
            image = replace(config.image, **change)
            imager = XrayImager(scene.anatomy, scene.device, ct=scene.imager.ct, config=image)
            planes = tuple(imager.plane(angles, pose=scene.pose) for angles in scene.angles_deg)
            changed = replace(scene, imager=imager, planes=planes)
            lit, before = changed.signals(None, contrast=1.0, seed=900_001), changed.signals(None, seed=900_002)
            found = register(scene.anatomy, [scene.view(0), scene.view(1)], lit, before)
            errors[name].append(vessel_error_mm(scene.anatomy, scene.pose, found.pose))
            exposures[name] += expose(changed, found, cases)
    return [_row(name, exposures[name], float(np.median(errors[name]))) for name in CHANGES]


def _row(name: str, exposures: list[Exposure], registration_mm: float) -> dict[str, Any]:
    """Return the figures of one kind of image."""
    two = summary(one for one in exposures if one.wire and one.views == 2)
    single = summary(one for one in exposures if one.wire and one.views == 1)
    return {
        "images": name,
        "along_px": round(two["tip_along_median_px"], 2),
        "across_px": round(two["tip_across_median_px"], 2),
        "missed": round(two["missed_share"], 3),
        "missed_one_view": round(single["missed_share"], 3),
        "in_own_95": round(two["inside_own_95_share"], 3),
        "false_alarms": round(float(np.mean([one.found for one in exposures if not one.wire])), 3),
        "registration_mm": round(registration_mm, 3),
    }
