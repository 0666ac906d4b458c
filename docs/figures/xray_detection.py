"""Write the figures of detection and registration into docs/evidence/detection.md.

`python -m benchmarks xray --json > FILE`, then `python docs/figures/xray_detection.py FILE`.
"""

from __future__ import annotations

import sys
from pathlib import Path
from statistics import median
from typing import Any

sys.path.append(str(Path(__file__).parents[2]))  # where `benchmarks` is

from benchmarks.figures import fill
from endopilot.files import read_json


def tables(found: dict[str, Any]) -> str:
    """Return the tables as Markdown."""
    bars, one = found["bars"], found["one_view"]
    poses = found["registration"]
    two_views = [row["two_views_mm"] for row in poses]
    single = [value for row in poses for value in row["one_view_mm"]]
    rows = [
        "| | two views | bar | one view |",
        "|---|---|---|---|",
        f"| error along the wire, median | {found['tip_along_median_px']:.2f} pixels "
        f"| ≤ {bars['tip_along_median_px']:g} | {one['tip_along_median_px']:.2f} pixels |",
        f"| error across the wire, median | {found['tip_across_median_px']:.2f} pixels "
        f"| ≤ {bars['tip_across_median_px']:g} | {one['tip_across_median_px']:.2f} pixels |",
        f"| error of Δtip, median | {found['tip_along_median_mm']:.2f} mm | ≤ {bars['tip_along_median_mm']:g} "
        f"| {one['tip_along_median_mm']:.2f} mm |",
        f"| error in space, median, 95th percentile | {found['tip_in_space_median_mm']:.2f}, "
        f"{found['tip_in_space_p95_mm']:.2f} mm | | {one['tip_in_space_median_mm']:.2f}, "
        f"{one['tip_in_space_p95_mm']:.2f} mm |",
        f"| missed: none found, or more than 10 pixels off | {100 * found['missed_share']:.1f} % "
        f"| ≤ {100 * bars['missed_share']:g} % | {100 * one['missed_share']:.1f} % |",
        f"| tips within the detector's own 95 % region | {100 * found['inside_own_95_share']:.0f} % | "
        f"| {100 * one['inside_own_95_share']:.0f} % |",
        f"| wires | {found['images']} | | {one['images']} |",
        f"| error of the vessel's place, median of {len(poses)} patients (largest) "
        f"| {found['registration_error_mm']:.2f} ({max(two_views):.2f}) mm | ≤ {bars['registration_error_mm']:g}; "
        f"one view ≤ {bars['registration_error_one_view_mm']:g} "
        f"| {found['registration_error_one_view_mm']:.2f} ({max(single):.2f}) mm |",
        "",
        "| error of the vessel's place, median (largest), mm | contrast | and one wire | and four wires |",
        "|---|---|---|---|",
        *refined_rows(poses),
        "",
        f"A wire is found in {100 * found['false_alarms_share']:.0f} % of the exposures without one, over all doses, "
        f"with and without contrast. An image without contrast is refused by registration in "
        f"{sum(row['refused_without_contrast'] for row in poses)} of {len(poses)} patients. "
        f"{motion_sentence(found)} "
        f"{found['images_per_second']:.0f} images a second of 512 × 512 pixels were made on one core, while others "
        "were busy.",
        "",
        "| | wires | along, pixels | across, pixels | in space, mm | missed |",
        "|---|---|---|---|---|---|",
    ]
    rows += [
        f"| {name} | {row['images']} | {row['tip_along_median_px']:.2f} | {row['tip_across_median_px']:.2f} "
        f"| {row['tip_in_space_median_mm']:.2f} | {100 * row['missed_share']:.0f} % |"
        for name, row in found["by"].items()
        if row["images"]
    ]
    return "\n".join(rows)


def motion_sentence(found: dict[str, Any]) -> str:
    """Return how well a run of contrast shows the patients' motion, in words."""
    errors = [row["motion_mm"] for row in found["registration"]]
    measured = [each["measured"] for each in errors if each["measured"] is not None]
    return (
        f"With heart and breath, a run of contrast finds the vessel to within {found['motion_error_mm']:.2f} mm "
        f"(median of {len(measured)} patients; largest {max(measured):.2f}), the published mean motion to within "
        f"{found['motion_error_of_published_mean_mm']:.2f} mm (largest {max(each['mean'] for each in errors):.2f})."
    )


def refined_rows(poses: list[dict[str, Any]]) -> list[str]:
    """Return how the error of a registered pose changes with images of wires, as rows of Markdown."""
    two = [[row["two_views_mm"], *row["refined_mm"]["two_views"]] for row in poses]
    rows = {"two views, wires in both": two}
    for name, title in (("one_view", "one view, wires in it"), ("other_view", "one view, wires in another")):
        rows[title] = [
            [before, *after]
            for row in poses
            for before, after in zip(row["one_view_mm"], row["refined_mm"][name], strict=True)
        ]
    return [
        f"| {title} | "
        + " | ".join(f"{median([e[i] for e in errors]):.2f} ({max(e[i] for e in errors):.2f})" for i in (0, 1, -1))
        + " |"
        for title, errors in rows.items()
    ]


if __name__ == "__main__":
    text = tables(read_json(Path(sys.argv[1])))
    fill("evidence/detection.md", "detection", text)
