"""Share of the atlas's vessels that is labelled correctly: `measure_labels`."""

from __future__ import annotations

from collections import defaultdict
from typing import Any, Literal

import numpy as np

from benchmarks.figures import Bar
from endopilot.anatomy.labels import dominance, label_tree
from endopilot.atlas.atlas import AtlasConfig, make_patient_tree
from endopilot.settings import Count, Seed
from endopilot.types import VesselTree

BAR = Bar(0.95, at_least=True)
"""Bar: share of the centerline length that must be labelled correctly in every anatomy."""


def measure_labels(*, count: Count = 40, seed: Seed = 0) -> list[dict[str, Any]]:
    """Label the sections of synthetic coronary arteries, and compare with the truth.

    The sections are named from the shape alone.

    Args:
        count: patients of each kind.
        seed: seed of the atlas.

    Returns:
        One row an anatomy: `right` (share of the centerline length, all patients together), `worst_patient` (share in
        the worst one), `dominance_right` (share of patients), `confusions` (the three pairs
        "truth as label" with the largest shares of the length) and `passed` (`right` reaches `BAR`).
    """
    return [_measure("rca", count, seed), _measure("lca", count, seed)]


Lengths = dict[tuple[str, str], float]
"""Length in mm for pairs of true and found section."""


def label_agreement(truth: VesselTree, found: VesselTree) -> Lengths:
    """Return the length in mm for every pair of true and found section; both trees have the same branches."""
    lengths: defaultdict[tuple[str, str], float] = defaultdict(float)
    for one, two in zip(truth.branches, found.branches, strict=True):
        steps = np.diff(one.centerline.abscissa)
        for a, b, step in zip(one.section[1:], two.section[1:], steps, strict=True):
            lengths[truth.section_names[a], found.section_names[b]] += float(step)
    return lengths


def _measure(anatomy: Literal["rca", "lca"], count: int, seed: int) -> dict[str, Any]:
    config = AtlasConfig(vessel=anatomy, count=count, seed=seed)
    total: Lengths = defaultdict(float)
    shares, dominances = [], []
    for index in range(count):
        truth, drawn = make_patient_tree(config, index)
        found = label_tree(truth, anatomy)
        lengths = label_agreement(truth, found)
        shares.append(_right(lengths))
        for pair, length in lengths.items():
            total[pair] += length
        dominances.append(dominance(found) == drawn["dominance"])
    wrong = [(pair, length) for pair, length in sorted(total.items(), key=lambda item: -item[1]) if pair[0] != pair[1]]
    return {
        "anatomy": anatomy,
        "patients": count,
        "right": round(_right(total), 4),
        "worst_patient": round(min(shares), 4),
        "dominance_right": round(float(np.mean(dominances)), 3),
        "confusions": {f"{a} as {b}": round(length / sum(total.values()), 4) for (a, b), length in wrong[:3]},
        "passed": BAR.met(_right(total)),
    }


def _right(lengths: Lengths) -> float:
    return sum(length for (a, b), length in lengths.items() if a == b) / sum(lengths.values())
