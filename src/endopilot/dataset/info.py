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
from endopilot.dataset import parquet, schema
from endopilot.dataset.loader import read_manifest
from endopilot.files import read_json, reading, writing
from endopilot.progress import progress
from endopilot.types import SAMPLE_PERIOD_S

BINS = 400
_TIP = ("tip_bend_rad", "tip_stiffness_factor")
_QUANTILES = {"p5": 0.05, "median": 0.5, "p95": 0.95, "p99": 0.99}


@dataclass(frozen=True, eq=False)
class Histogram:
    """How often a quantity took which value, over all valid samples.

    Attributes:
        unit: "" if it has none.
        edges: of the bins, increasing; values beyond count in the outermost.
        counts: samples in each bin.
    """

    title: str
    unit: str
    edges: Float[np.ndarray, "bins_1"]
    counts: Float[np.ndarray, "bins"]

    def add(self, values: Float[np.ndarray, "n"]) -> None:
        """Count some more values."""
        inside = np.clip(values, self.edges[0], self.edges[-1])
        self.counts[:] += np.histogram(inside, self.edges)[0]

    def quantiles(self) -> dict[str, float]:
        """Return the 5th, 50th, 95th and 99th percentile, to within a bin."""
        below = np.append(0.0, np.cumsum(self.counts)) / max(self.counts.sum(), 1.0)
        return {name: round(float(np.interp(q, below, self.edges)), 5) for name, q in _QUANTILES.items()}


@dataclass(frozen=True, eq=False)
class Description:
    """A dataset in figures.

    Attributes:
        histograms: by the name of their picture.
        branch_visits: share of the navigations whose tip was in n branches, for n = 0, 1, 2, ...
        manoeuvres: share of the samples that are insertion, retraction, spin and pause.
    """

    figures: dict[str, Any]
    histograms: dict[str, Histogram]
    branch_visits: Float[np.ndarray, "branches"]
    manoeuvres: dict[str, float]


def describe_dataset(folder: Path) -> Description:
    """Count what a dataset holds, one file at a time.

    γ/r is the paper's offset ratio; a wire of radius r_w touches the wall where γ/(r − r_w) is 1.

    Raises:
        InputError: the folder holds no finished dataset, or a file of it is missing, damaged or of another version.
    """
    folder = Path(folder)
    with reading(folder, "make the dataset again"):
        return _described(folder, *read_manifest(folder))


def _described(folder: Path, manifest: dict[str, Any], info: dict[str, Any]) -> Description:
    stats = read_json(folder / schema.STATS_PATH)
    wire_mm = manifest["device"]["diameter_mm"] / 2
    histograms = _empty(float(stats["observation.state"]["max"][0]))
    episodes: dict[str, list[Any]] = {}
    visits = Counter[int]()
    with progress("Reading the dataset", total=manifest["files"]) as advance:
        for number in range(manifest["files"]):
            data_path, episodes_path = schema.paths_of_file(folder, number)
            for name, values in parquet.read_table(episodes_path, manifest["key"]).to_pydict().items():
                episodes.setdefault(name, []).extend(values)
            table = parquet.read_table(data_path, manifest["key"])
            _count(table, wire_mm, histograms, visits, manifest["samples_per_episode"])
            advance()
    total = max(sum(visits.values()), 1)
    branch_visits = np.array([visits[n] / total for n in range(max(visits, default=0) + 1)])
    pairs = set(zip(episodes["split"], episodes["anatomy"], strict=True))
    reasons = Counter(re.sub(r" after .*", "", reason) for reason in episodes["invalid_reason"] if reason)
    files = [file for file in folder.rglob("*") if file.is_file()]
    catheters = [catheter["name"] for catheter in manifest.get("catheters", ())]
    figures = {
        "anatomies": len(manifest["anatomies"]),
        "navigations": info["total_episodes"],
        "samples": info["total_frames"],
        "hours": round(info["total_frames"] * SAMPLE_PERIOD_S / 3600, 2),
        "megabytes": round(sum(file.stat().st_size for file in files) / 1e6, 2),
        "device": manifest["device"]["name"],
        **({"catheters": catheters} if catheters else {}),
        "control": schema.actuation_of(info["features"]),
        "made_by": manifest["settings"]["version"],
        "splits": dict(Counter(episodes["split"])),
        "anatomies_by_split": dict(Counter(split for split, _ in sorted(pairs))),
        "manoeuvres": {name: round(share, 4) for name, share in manifest["manoeuvres"].items()},
        "stopped_short": sum(episodes["stopped_short"]),
        "invalid": len(manifest["invalid"]["which"]),
        "invalid_reasons": dict(reasons),
        **{f"{h.title} {h.unit}".strip(): h.quantiles() for h in histograms.values()},
        "branches visited": {str(n): round(float(share), 4) for n, share in enumerate(branch_visits) if share},
        **{name: [round(of(episodes[name]), 4) for of in (min, max)] for name in ("friction", *_TIP)},
    }
    return Description(figures, histograms, branch_visits, manifest["manoeuvres"])


def _empty(deepest_mm: float) -> dict[str, Histogram]:
    """Return the quantities that are counted, with nothing counted yet."""
    ratio, force = np.linspace(0.0, 1.2, BINS + 1), np.append(0.0, np.geomspace(1e-4, 10.0, BINS))

    def empty(title: str, unit: str, edges: np.ndarray) -> Histogram:
        return Histogram(title, unit, edges, np.zeros(len(edges) - 1))

    return {
        "insertion": empty("inserted length Δ", "mm", np.linspace(0.0, max(deepest_mm, 1.0), BINS + 1)),
        "offset-ratio": empty("offset ratio γ/r", "", ratio),
        "wall-ratio": empty("offset ratio γ/(r − r_w)", "", ratio),
        "contact-force": empty("largest contact force", "N", force),
    }


def _count(table, wire_mm: float, histograms: dict[str, Histogram], visits: Counter[int], samples: int) -> None:
    """Count one file's valid samples, and the branches that each valid navigation reached."""
    valid = parquet.column_values(table, "valid")
    state = parquet.column_values(table, "observation.state")[valid].astype(float)
    radius = _of_wire(table, "lumen_radius_mm")[valid].astype(float)
    histograms["insertion"].add(state[:, 0])
    histograms["offset-ratio"].add(state[:, 3] / radius)
    histograms["wall-ratio"].add(safety_ratio(state[:, 3], radius, wire_mm))
    histograms["contact-force"].add(parquet.column_values(table, "contact_force_max_n")[valid].astype(float))
    branch = np.sort(_of_wire(table, "branch").reshape(-1, samples), axis=1)
    distinct = 1 + (np.diff(branch, axis=1) != 0).sum(axis=1)
    visits.update(distinct[valid.reshape(-1, samples).all(axis=1)].tolist())


def _of_wire(table, name: str) -> np.ndarray:
    """Return the wire's number in each row of a column that holds one of each device."""
    return parquet.column_values(table, name).reshape(len(table), -1)[:, 0]


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
