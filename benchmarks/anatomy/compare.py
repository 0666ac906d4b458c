"""Any set of anatomies beside the atlas: every quantity of `vessel_shape`, and a distance between the two sets."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import wasserstein_distance

from benchmarks.anatomy.vessel_shape import vessel_shape
from endopilot.anatomy.io import read_anatomy
from endopilot.anatomy.labels_tree import (
    ARCH_SECTIONS,
    CEREBRAL_SECTIONS,
    LCA_SECTIONS,
    PORTAL_SECTIONS,
    RCA_SECTIONS,
)
from endopilot.atlas.atlas import AtlasConfig, make_atlas
from endopilot.errors import InputError
from endopilot.progress import progress
from endopilot.types import Anatomy

KINDS = {
    "rca": RCA_SECTIONS,
    "lca": LCA_SECTIONS,
    "cerebral": CEREBRAL_SECTIONS,
    "arch": ARCH_SECTIONS,
    "portal": PORTAL_SECTIONS,
}
"""Kinds of vessel trees, recognised by the names of their sections."""

Values = dict[str, list[float]]
"""The values of each quantity over all anatomies of a set."""


def compare_with_atlas(folders: Sequence[Path], atlas: AtlasConfig) -> list[dict[str, Any]]:
    """Measure anatomies beside patients of the atlas.

    Args:
        folders: anatomies, or folders that hold anatomies.
        atlas: patients to compare with; its `anatomy` is replaced by each kind of tree that is given.

    Returns:
        A row for each kind and quantity: `kind`, `quantity`, of the given ones and of the atlas' the number of values,
        the median and the 5th and 95th percentile (`given_count`, `given`, `given_p5`, `given_p95`, `atlas_count`, …),
        and `distance` (see `scaled_distance`).

    Raises:
        InputError: a folder holds no anatomy, or an anatomy's sections are not those of one of the atlas' kinds.
    """
    found = anatomy_folders(folders)
    given: defaultdict[str, list[Values]] = defaultdict(list)
    with progress("Given anatomies", len(found)) as advance:
        for folder in found:
            anatomy = read_anatomy(folder)
            given[_kind(anatomy, folder)].append(vessel_shape(anatomy))
            advance()
    rows = []
    for kind in sorted(given, key=list(KINDS).index):
        drawn = []
        with progress(f"Atlas, {kind}", atlas.count) as advance:
            for anatomy in make_atlas(config=replace(atlas, vessel=kind)):
                drawn.append(vessel_shape(anatomy))
                advance()
        rows += compared(kind, together(given[kind]), together(drawn))
    return rows


def anatomy_folders(folders: Iterable[Path]) -> list[Path]:
    """Return the anatomies among folders and in them.

    Raises:
        InputError: a folder neither is an anatomy nor holds one.
    """
    found = []
    for folder in folders:
        own = (
            [folder] if (folder / "anatomy.json").exists() else sorted(p.parent for p in folder.glob("*/anatomy.json"))
        )
        if not own:
            raise InputError(f"{folder}: is no anatomy and holds none; make them with `endopilot anatomy MASK...`")
        found += own
    return found


def _kind(anatomy: Anatomy, folder: Path) -> str:
    for kind, names in KINDS.items():
        if anatomy.tree.section_names == names:
            return kind
    raise InputError(
        f"{folder}: its sections are not those of a vessel of the atlas ({', '.join(KINDS)}); make it with "
        "`endopilot anatomy --vessel rca` or lca"
    )


def together(shapes: Iterable[Values]) -> Values:
    """Return the values of all anatomies in one list for each quantity."""
    values: defaultdict[str, list[float]] = defaultdict(list)
    for shape in shapes:
        for quantity, found in shape.items():
            values[quantity] += found
    return dict(values)


def compared(kind: str, given: Values, atlas: Values) -> list[dict[str, Any]]:
    """Return a row for each quantity that either set has; see `compare_with_atlas`."""
    rows = []
    for quantity in [*given, *(name for name in atlas if name not in given)]:
        sets = {"given": given.get(quantity, []), "atlas": atlas.get(quantity, [])}
        row: dict[str, Any] = {"kind": kind, "quantity": quantity}
        for name, values in sets.items():
            low, middle, high = np.quantile(values, (0.05, 0.5, 0.95)) if values else (None, None, None)
            row |= {f"{name}_count": len(values), name: _short(middle)}
            row |= {f"{name}_p5": _short(low), f"{name}_p95": _short(high)}
        rows.append(row | {"distance": _short(scaled_distance(sets["given"], sets["atlas"]))})
    return rows


def scaled_distance(one: Sequence[float], two: Sequence[float]) -> float | None:
    """Return the Wasserstein-1 distance between two samples over their pooled spread, √((s₁² + s₂²)/2).

    It is the mean shift, in standard deviations, that would carry one sample over into the other: 0 for equal samples,
    1 for two normal ones a standard deviation apart. None where a sample is empty, or both are without spread and
    differ.
    """
    if not len(one) or not len(two):
        return None
    apart = float(wasserstein_distance(one, two))
    spread = float(np.sqrt(0.5 * (np.var(one) + np.var(two))))
    if spread > 0:
        return apart / spread
    return 0.0 if apart == 0 else None


def _short(value: float | None) -> float | None:
    return None if value is None else float(f"{value:.3g}")
