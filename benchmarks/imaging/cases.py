"""Patients and scans of `python -m benchmarks imaging`, with one difficulty of real scans at a time."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Literal, get_args

import numpy as np

from endopilot.atlas.atlas import AtlasConfig
from endopilot.phantom.phantom import PhantomConfig

VESSELS = ("rca", "lca")
"""Coronary trees of the cases, in turn."""

Difficulty = Literal[
    "clean", "slices", "motion", "steps", "grain", "blooming", "stents", "leads", "veins", "appendage", "graft"
]
"""What the scans of a run have in common, beside what every scan varies."""
DIFFICULTIES: tuple[Difficulty, ...] = get_args(Difficulty)


def draw_case(seed: int, index: int, difficulty: Difficulty = "clean") -> tuple[AtlasConfig, PhantomConfig]:
    """Return the patient and the scan of a case: voxels, calcium, background and all that the phantom draws."""
    key = np.array([seed, index], dtype=np.uint64)
    generator = np.random.Generator(np.random.Philox(key=key, counter=1))
    patients = AtlasConfig(vessel=VESSELS[index % len(VESSELS)], seed=seed, stenosis_share=0.5)
    right_heart = float(generator.uniform(0.2, 0.95))
    scan = PhantomConfig(
        in_plane_mm=float(generator.uniform(0.32, 0.45)),
        slice_mm=float(generator.uniform(0.4, 0.7)),
        calcium=float(generator.uniform(0.0, 6.0)),
        right_heart=(right_heart, right_heart),
    )
    # A stream of its own: the rest of the scan stays the same.
    generator = np.random.Generator(np.random.Philox(key=key, counter=2))
    return patients, replace(scan, **_disturbance(difficulty, generator))


def _disturbance(difficulty: Difficulty, generator: np.random.Generator) -> dict[str, Any]:
    """Draw how much of the difficulty a scan has."""

    def between(low: float, high: float) -> float:
        return float(generator.uniform(low, high))

    match difficulty:
        case "clean":
            return {}
        case "slices":
            return {"slice_mm": between(0.6, 1.25)}
        case "motion":
            return {"motion_mm": between(1.0, 3.0)}
        case "steps":
            return {"step_mm": between(1.0, 4.0), "slab_mm": between(20.0, 40.0)}
        case "grain":
            return {"grain_mm": between(0.6, 1.5)}
        case "blooming":
            return {"blooming_mm": between(0.3, 0.7), "calcium": between(4.0, 10.0)}
        case "stents":
            return {"stents": int(generator.integers(1, 4))}
        case "leads":
            return {"leads": int(generator.integers(1, 3))}
        case "veins":
            return {"veins": between(0.5, 0.9)}
        case "appendage":
            return {"appendage_mm": between(2.0, 5.0)}
        case "graft":
            return {"graft": True}
