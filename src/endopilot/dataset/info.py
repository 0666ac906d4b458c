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

BINS = 400
_QUANTILES = {"p5": 0.05, "median": 0.5, "p95": 0.95, "p99": 0.99}


@dataclass(frozen=True, eq=False)
class Histogram:
    """How often a quantity took which value in valid samples; outermost bins count what lies beyond."""

    title: str
    unit: str
    edges: Float[np.ndarray, "bins_1"]
    counts: Float[np.ndarray, "bins"]

    def quantiles(self) -> dict[str, float]:
        """Return the 5th, 50th, 95th and 99th percentile, to within a bin."""
        below = np.append(0.0, np.cumsum(self.counts)) / max(self.counts.sum(), 1.0)
        return {name: round(float(np.interp(q, below, self.edges)), 5) for name, q in _QUANTILES.items()}


@dataclass(frozen=True, eq=False)
class Description:
    """A dataset in figures: histograms by the name of their picture, the share of the navigations whose tip was in n =
    0, 1, ... branches, and the share of the samples of each manoeuvre."""

    figures: dict[str, Any]
    histograms: dict[str, Histogram]
    branch_visits: Float[np.ndarray, "branches"]
    manoeuvres: dict[str, float]


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
    length_mm, ratios = np.linspace(0.0, max(deepest.max(initial=0.0), 1.0), BINS + 1), np.linspace(0.0, 1.2, BINS + 1)
    forces = np.append(0.0, np.geomspace(1e-4, 10.0, BINS))
    histograms = {
        "insertion": _counted("inserted length Δ", "mm", length_mm, deepest),
        "offset-ratio": _counted("offset ratio γ/r", "", ratios, offset / radius),
        "wall-ratio": _counted("offset ratio γ/(r − r_w)", "", ratios, wall_ratio),
        "contact-force": _counted("largest contact force", "N", forces, force),
    }
    visited = 1 + (np.diff(np.sort(data.branch[valid.all(axis=1), :, 0], axis=1), axis=1) != 0).sum(axis=1)
    branch_visits = np.bincount(visited, minlength=1) / max(len(visited), 1)
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
        **{f"{h.title} {h.unit}".strip(): h.quantiles() for h in histograms.values()},
        "branches visited": {str(n): round(float(share), 4) for n, share in enumerate(branch_visits) if share},
        **{name: [round(float(of(values)), 4) for of in (np.min, np.max)] for name, values in of_wire.items()},
    }
    return Description(figures, histograms, branch_visits, manifest["manoeuvres"])


def _counted(title: str, unit: str, edges: Float[np.ndarray, "bins_1"], values: Float[np.ndarray, "n"]) -> Histogram:
    counts = np.histogram(np.clip(values, edges[0], edges[-1]), edges)[0]
    return Histogram(title, unit, edges, counts.astype(float))


def draw_pictures(description: Description, folder: Path) -> list[Path]:
    """Draw the distributions as PNG files, and return their paths."""
    from matplotlib.figure import Figure  # slow to import

    paths = []

    def keep(name: str, figure: Figure) -> None:
        paths.append(folder / f"{name}.png")
        with writing(paths[-1]) as partial:
            figure.savefig(partial, dpi=150)

    for name, histogram in description.histograms.items():
        keep(name, _histogram_figure(histogram, logarithmic=name == "contact-force"))
    visits = {str(n): float(share) for n, share in enumerate(description.branch_visits) if n > 0}
    keep("branches", _bars("branches that the tip was in", "navigations", visits))
    keep("manoeuvres", _bars("", "samples", description.manoeuvres))
    return paths


def _histogram_figure(histogram: Histogram, *, logarithmic: bool):
    figure, axes = _axes()
    wide = histogram.edges[::8] if not logarithmic else np.append(0.0, histogram.edges[1::8])
    counts = np.add.reduceat(histogram.counts, np.searchsorted(histogram.edges, wide[:-1]))
    share = 100 * counts / max(counts.sum(), 1)
    if logarithmic:  # the first bin, without any force, has no place on the axis: the title states it
        wide, none, share = wide[1:], share[0], share[1:]
        axes.set_xscale("log")
        axes.set_title(f"below {1e3 * wide[0]:g} mN in {none:.1f} % of the samples", fontsize=10)
    axes.bar(wide[:-1], share, width=np.diff(wide), align="edge", color=_COLOUR)
    for text, value in histogram.quantiles().items():
        if wide[0] <= value <= wide[-1] and text in ("median", "p95"):
            axes.axvline(
                value, color="#333333", lw=1, ls="-" if text == "median" else "--", label=f"{text} {value:.3g}"
            )
    axes.legend(frameon=False)
    axes.set_xlabel(f"{histogram.title}, {histogram.unit}".rstrip(", "))
    axes.set_ylabel("samples, %")
    return figure


def _bars(label: str, of: str, shares: dict[str, float]):
    figure, axes = _axes()
    bars = axes.bar(list(shares), [100 * share for share in shares.values()], color=_COLOUR)
    axes.bar_label(bars, fmt="%.1f")
    axes.set_xlabel(label)
    axes.set_ylabel(f"{of}, %")
    return figure


_COLOUR = "#0072B2"


def _axes():
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.0, 3.4), layout="constrained")
    axes = figure.add_subplot()
    axes.spines[["top", "right"]].set_visible(False)
    return figure, axes
