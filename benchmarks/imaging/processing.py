"""How far detection and registration fall in images that a C-arm has processed: `compare_processing`."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from benchmarks.imaging.xray import XrayBenchConfig, bench_xray

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
        A row for each kind of image: errors of two views at the usual dose without contrast (medians), the share of
        missed tips with two views and with one, of tips in the detector's own 95 % region, of images without a wire in
        which one is found, and the error of registration (median of the patients).
    """
    rows = []
    for name, change in CHANGES.items():
        found = bench_xray(replace(config, image=replace(config.image, **change)))
        one = found["one_view"]
        rows.append(
            {
                "images": name,
                "along_px": round(found["tip_along_median_px"], 2),
                "across_px": round(found["tip_across_median_px"], 2),
                "missed": round(found["missed_share"], 3),
                "missed_one_view": round(one["missed_share"], 3),
                "in_own_95": round(found["inside_own_95_share"], 3),
                "false_alarms": round(found["false_alarms_share"], 3),
                "registration_mm": round(found["registration_error_mm"], 3),
            }
        )
    return rows
