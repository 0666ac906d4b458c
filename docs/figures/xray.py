"""Write the figures of X-ray advice into docs/evidence/advice.md.

`python docs/figures/xray.py FOLDER`: FOLDER is what `endopilot advise` made.
"""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[2]))  # where `benchmarks` is

from benchmarks.figures import fill
from endopilot.belief.advise import FIGURES_FILE, PICTURE_FILE
from endopilot.files import read_json

PICTURE = Path(__file__).parents[1] / "images" / "xray.png"


def tables(folder: Path) -> str:
    """Return the tables as Markdown."""
    found = read_json(folder / FIGURES_FILE)
    cover, at, own = found["coverage"], found["adviser"], found["coverage_of_calibration_patients"]
    share = found["share_of_the_exposures_of_periodic_imaging"]
    equal = found["periodic_exposures_per_minute_with_the_same_missed_share"]
    error, half = cover["error_mae_mm"], cover["median_half_width_mm"]
    oracle = found["curves"]["oracle"][0]
    rows = [
        "| | measured | bar |",
        "|---|---|---|",
        f"| intervals of 45 s in which both bands hold throughout ({cover['intervals']}, {cover['patients']} patients) "
        f"| {100 * cover['simultaneous']:.1f} % | 87 to 93 % |",
        f"| the same in the worst decile of patients | {100 * cover['worst_decile_of_patients']:.0f} % | |",
        f"| samples in which they hold | {100 * cover['samplewise']:.1f} % | |",
        f"| share of γtip's half-width that the adviser uses | {at['offset_share']:g} | |",
        f"| events missed | {100 * at['missed_share']:.1f} % | ≤ 5 % |",
        f"| samples at the wall, unexposed for 0.5 s | {100 * at['wall_samples_without_exposure_share']:.0f} % | |",
        f"| exposures a minute | {at['exposures_per_minute']:.1f} | |",
        f"| of what periodic imaging needs to miss as many ({equal:.1f} a minute) | {share:.2f} | ≤ 0.33 |",
        f"| fewer frames than fluoroscopy at 7.5 Hz | {100 * at['fewer_frames_than_fluoroscopy']:.1f} % | ≥ 95 % |",
        f"| events a minute, which an oracle exposes | {oracle['events_per_minute']:.1f} | |",
        "",
        f"Mean error of Δtip and γtip: {error[0]:.3f} and {error[1]:.4f} mm; median half-width of the bands: "
        f"{half[0]:.2f} and {half[1]:.3f} mm. On the {own['patients']} calibration patients the bands hold throughout "
        f"{100 * own['simultaneous']:.1f} % of the intervals.",
        "",
        "| τ | δ, mm | events a minute | missed | exposures a minute |",
        "|---|---|---|---|---|",
    ]
    rows += [
        f"| {point['wall_ratio']:g} | {point['abscissa_mm']:g} | {point['events_per_minute']:.1f} "
        f"| {100 * point['missed_share']:.1f} % | {point['exposures_per_minute']:.1f} |"
        for point in found["other_thresholds"]
    ]
    return "\n".join(rows)


if __name__ == "__main__":
    folder = Path(sys.argv[1])
    fill("evidence/advice.md", "xray", tables(folder))
    shutil.copyfile(folder / PICTURE_FILE, PICTURE)
