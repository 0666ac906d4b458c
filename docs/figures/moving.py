"""Lets the agent navigate in patients that move, and writes the table of docs/evidence/navigation.md."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np

sys.path.append(str(Path(__file__).parents[2]))  # where `benchmarks` is

from benchmarks.figures import fill
from endopilot.atlas.atlas import AtlasConfig, make_patient
from endopilot.control.navigate import NavigateConfig, navigate

PATIENTS = (("rca", 0), ("lca", 0), ("rca", 1), ("lca", 1))
DEPTH_SHARE = 0.6
"""The target lies at this share of the longest path."""
CASES: tuple[dict[str, Any], ...] = (
    {"motion": "still"},
    {"motion": "breathing"},
    {"motion": "breathing", "motion_known": "nothing"},
    {"motion": "heartbeat"},
    {"motion": "heartbeat", "motion_known": "nothing"},
    {"motion": "both", "motion_known": "exact"},
    {"motion": "both"},
    {"motion": "both", "motion_known": "nothing"},
)


def main() -> None:
    """Write the table in place of the one that is there."""
    rows = []
    for case in CASES:
        records = []
        for seed, (kind, number) in enumerate(PATIENTS):
            patient = make_patient(AtlasConfig(vessel=kind, seed=70), number)
            path = patient.tree.longest_path()
            place = path.points[np.searchsorted(path.abscissa, DEPTH_SHARE * path.abscissa[-1])]
            config = NavigateConfig(world="drawn", seed=seed, motion_seed=seed, **case)
            found = navigate(patient, ",".join(f"{x:.2f}" for x in place), config=config)
            records.append(found.record)
        inside = np.concatenate([record.in_bands for record in records])
        minutes = sum(record.seconds for record in records) / 60
        known = "" if case["motion"] == "still" else case.get("motion_known", "published")
        safe = sum(record.success and record.safe for record in records)
        rows.append(
            f"| {case['motion']} | {known} | {safe} of {len(records)} | {np.median([r.seconds for r in records]):.0f} "
            f"| {sum(record.exposures for record in records) / minutes:.0f} | {100 * inside.mean():.0f} % "
            f"| {max(record.peak_force_n for record in records):.2f} |"
        )
        print(rows[-1], flush=True)
    table = [
        "| motion | known | reached safely | median time, s | exposures a minute "
        "| decisions in both bands | largest wall force, N |",
        "|---|---|---|---|---|---|---|",
        *rows,
    ]
    fill("evidence/navigation.md", "moving", table)


if __name__ == "__main__":
    main()
