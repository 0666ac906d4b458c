"""Figures of the verification: the core's points over the reference's curve."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from endopilot.verification.free_rod import Case, Picture

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_STYLES: dict[str, dict[str, Any]] = {
    "reference": {"color": "0.55", "lw": 3.5, "zorder": 1},
    "core": {"color": "tab:blue", "marker": "o", "ms": 3.5, "lw": 0.7, "zorder": 2},
    "mark": {"color": "tab:red", "marker": "x", "ms": 9, "mew": 2, "ls": "", "zorder": 3},
}
_SHADES = {"reference": ("0.5", "0.75"), "core": ("tab:blue", "tab:orange"), "mark": ("tab:red", "tab:green")}
_MOST_MARKERS = 24
_FEW_POINTS = 12


def draw(cases: Sequence[Case], folder: Path) -> None:
    """Draw one figure a case into a folder, named after the case. Skipped cases have none."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    folder.mkdir(parents=True, exist_ok=True)
    for case in cases:
        if case.skipped:
            continue
        figure, axes = plt.subplots(figsize=(5.6, 4.0), layout="constrained")
        if case.picture is None:
            axes.bar(["reference", "core"], [case.reference, case.value], color=["0.7", "tab:blue"])
        else:
            _fill(axes, case.picture)
        verdict = "passed" if case.error <= case.bar else "FAILED"
        axes.set_title(f"{case.case}\nerror {case.error:.2g}, bar {case.bar:.2g}: {verdict}", fontsize=10)
        figure.savefig(folder / f"{file_name(case.case)}.png", dpi=110)
        plt.close(figure)


def file_name(case: str) -> str:
    """Return the name of a case's figure, without its ending: letters, digits and single hyphens."""
    kept = "".join(character if character.isalnum() else " " for character in case)
    return "-".join(kept.split())


def _fill(axes: Axes, picture: Picture) -> None:
    used: dict[str, int] = {}
    for curve in picture.curves:
        number = used[curve.style] = used.get(curve.style, -1) + 1
        style = dict(_STYLES[curve.style])
        style["color"] = _SHADES[curve.style][number % 2]
        if curve.style == "core":
            style["markevery"] = max(1, len(curve.x) // _MOST_MARKERS)  # else they hide the reference
            style["ls"] = "-" if len(curve.x) > _FEW_POINTS else ""
        axes.plot(np.asarray(curve.x), np.asarray(curve.y), label=curve.name, **style)
    axes.set(xlabel=picture.horizontal, ylabel=picture.vertical)
    if picture.logarithmic:
        axes.set(xscale="log", yscale="log")
    if picture.equal:
        axes.set_aspect("equal", adjustable="datalim")
    axes.grid(alpha=0.25)
    axes.legend(fontsize=8)
