"""What a dataset holds: counts, distributions, and why navigations failed (`describe_dataset`), with pictures."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from endopilot.anatomy.projection import safety_ratio
from endopilot.dataset.loader import Dataset, read_dataset
from endopilot.files import reading, writing
from endopilot.types import SAMPLE_PERIOD_S

_QUANTILES = {"p5": 0.05, "median": 0.5, "p95": 0.95, "p99": 0.99}
_COLOUR, _LEAST_N, _BINS = "#0072B2", 1e-4, 50


@dataclass(frozen=True, eq=False)
class Description:
    """A dataset in figures, and what its pictures show by their names: the valid samples of quantities, and the shares
    of navigations whose tip was in so many branches and of samples of each manoeuvre, each with its label."""

    figures: dict[str, Any]
    quantities: dict[str, tuple[str, Float[np.ndarray, "samples"]]]
    shares: dict[str, tuple[str, dict[str, float]]]


def describe_dataset(folder: Path) -> Description:
    """Count what a dataset holds; γ/r is the paper's offset ratio, and a wire of radius r_w touches the wall where γ/(r
    − r_w) is 1. Raises InputError for no finished dataset, or a file that is missing, damaged or of another version."""
    data = read_dataset(folder)
    with reading(data.folder, "make the dataset again"):
        return _described(data)


def _described(data: Dataset) -> Description:
    manifest, valid = data.manifest, data.valid
    deepest, offset, radius, force = (
        signal[valid].astype(float).reshape(valid.sum(), -1)[:, 0]
        for signal in (data.inserted_length, data.tip_offset, data.lumen_radius, data.contact_force_max)
    )
    wall_ratio = safety_ratio(offset, radius, manifest["device"]["diameter_mm"] / 2)
    quantities = {
        "insertion": ("inserted length Δ mm", deepest),
        "offset-ratio": ("offset ratio γ/r", offset / radius),
        "wall-ratio": ("offset ratio γ/(r − r_w)", wall_ratio),
        "contact-force": ("largest contact force N", force),
    }
    visited = 1 + (np.diff(np.sort(data.branch[valid.all(axis=1), :, 0], axis=1), axis=1) != 0).sum(axis=1)
    visits = {str(n): count / len(visited) for n, count in enumerate(np.bincount(visited).tolist()) if n > 0}
    pairs = set(zip(data.split.tolist(), data.anatomy.tolist(), strict=True))
    reasons = Counter(re.sub(r" after .*", "", each["invalid_reason"]) for each in manifest["invalid"]["which"])
    files = [file for file in data.folder.rglob("*") if file.is_file()]
    catheters = [catheter.name for catheter in data.stack.catheters]
    of_wire = {"friction": data.friction[:, 0], "tip_bend_rad": data.tip_bend}
    of_wire["tip_stiffness_factor"] = data.tip_stiffness_factor
    figures = {
        "anatomies": len(manifest["anatomies"]),
        "navigations": len(data),
        "samples": valid.size,
        "hours": round(valid.size * SAMPLE_PERIOD_S / 3600, 2),
        "megabytes": round(sum(file.stat().st_size for file in files) / 1e6, 2),
        "device": manifest["device"]["name"],
        **({"catheters": catheters} if catheters else {}),
        "control": manifest["config"]["control"],
        "made_by": manifest["settings"]["version"],
        "splits": dict(Counter(data.split.tolist())),
        "anatomies_by_split": dict(Counter(split for split, _ in sorted(pairs))),
        "manoeuvres": {name: round(share, 4) for name, share in manifest["manoeuvres"].items()},
        "stopped_short": manifest["stopped_short"],
        "invalid": len(manifest["invalid"]["which"]),
        "invalid_reasons": dict(reasons),
        **{label: _quantiles(values) for label, values in quantities.values()},
        "branches visited": {n: round(share, 4) for n, share in visits.items() if share},
        **{name: [round(float(of(values)), 4) for of in (np.min, np.max)] for name, values in of_wire.items()},
    }
    shares = {
        "branches": ("navigations by the branches that the tip was in", visits),
        "manoeuvres": ("samples", manifest["manoeuvres"]),
    }
    return Description(figures, quantities, shares)


def _quantiles(values: Float[np.ndarray, "samples"]) -> dict[str, float]:
    found = np.quantile(values, list(_QUANTILES.values())) if len(values) else np.zeros(len(_QUANTILES))
    return dict(zip(_QUANTILES, found.round(5).tolist(), strict=True))


def draw_pictures(description: Description, folder: Path) -> list[Path]:
    """Draw the distributions as PNG files, and return their paths."""
    from matplotlib.figure import Figure  # slow to import

    paths = []
    for name, (label, shown) in (description.quantities | description.shares).items():
        figure = Figure(figsize=(6.0, 3.4), layout="constrained")
        axes = figure.add_subplot()
        axes.spines[["top", "right"]].set_visible(False)
        if isinstance(shown, dict):
            axes.bar_label(axes.bar(list(shown), [100 * share for share in shown.values()], color=_COLOUR), fmt="%.1f")
            axes.set_ylabel(f"{label}, %")
        else:
            bins: Any = _BINS
            if name == "contact-force":
                bins = np.geomspace(_LEAST_N, max(shown.max(initial=0.0), 1.0), _BINS)
                none = 100 * (shown < _LEAST_N).mean() if len(shown) else 0.0
                axes.set_xscale("log")
                axes.set_title(f"below {1e3 * _LEAST_N:g} mN in {none:.1f} % of the samples", fontsize=10)
            axes.hist(shown, bins, weights=np.full(len(shown), 100 / max(len(shown), 1)), color=_COLOUR)
            for text, style in (("median", "-"), ("p95", "--")):
                value = description.figures[label][text]
                axes.axvline(value, color="#333333", lw=1, ls=style, label=f"{text} {value:.3g}")
            axes.legend(frameon=False)
            axes.set(xlabel=label, ylabel="samples, %")
        paths.append(folder / f"{name}.png")
        with writing(paths[-1]) as partial:
            figure.savefig(partial, dpi=150)
    return paths
