"""Colours and matplotlib style of all pictures, a vessel's sections as lines, and a figure as PNG."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
from jaxtyping import Float, Int
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure

# Okabe & Ito, "Color universal design" (2008): distinguishable with any kind of colour vision.
BLACK, ORANGE, SKY, GREEN = "#1a1a1a", "#E69F00", "#56B4E9", "#009E73"
YELLOW, BLUE, VERMILLION, PURPLE, GREY = "#F0E442", "#0072B2", "#D55E00", "#CC79A7", "#8a8f98"
CATHETER_COLORS = ("#19b5c8", "#8e6cf0")  # from the inside out; the first is that of the cockpit
_SECTION_COLORS = ListedColormap(mpl.colormaps["tab10"]([0, 1, 2, 3, 4, 5, 6, 8, 9]))  # without the catheter's grey
_THICKEST = 9.0  # of the line of a vessel, points

STYLE: dict[Any, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 9.5,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#70757d",
    "axes.grid": True,
    "grid.color": "#e4e6ea",
    "grid.linewidth": 0.8,
    "axes.axisbelow": True,
    "axes.titlesize": 10.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "lines.linewidth": 1.8,
    "figure.dpi": 130,
}


def png(figure: Figure, *, dpi: int = STYLE["figure.dpi"]) -> bytes:
    """Return a figure as the bytes of a PNG file, of so many dots an inch."""
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=dpi)
    return stream.getvalue()


def section_colors(count: int) -> Any:
    """Return a colour for each of so many sections; of many, neighbours in the list have similar ones."""
    if count <= _SECTION_COLORS.N:
        return _SECTION_COLORS
    return mpl.colormaps["tab20"] if count <= 20 else mpl.colormaps["turbo"].resampled(count)


def plain_text(name: str) -> str:
    """Return a name that matplotlib shows as it is: no formula, no line break, and not left out for its underscore."""
    text = "".join(letter if letter.isprintable() else "?" for letter in name).replace("$", r"\$")
    return f"\u200b{text}" if text.startswith("_") else text


def draw_vessel(
    axes: Axes,
    pieces: Float[np.ndarray, "n 2 2"],
    radius: Float[np.ndarray, "n"],
    section: Int[np.ndarray, "n"],
    names: Sequence[str],
    one_color: str | None = None,
) -> None:
    """Draw straight pieces of centerlines (both ends of each, and its radius, mm), as thick as the vessel is wide, with
    sections by colour and a legend, or in `one_color`."""
    present = np.unique(section)
    palette, width = section_colors(len(present)), _THICKEST * radius / radius.max()
    for number, index in enumerate(present):
        own, color = section == index, one_color or palette(number)
        lines = LineCollection(list(pieces[own]), linewidths=width[own].tolist(), colors=[color], capstyle="round")
        axes.add_collection(lines)
        axes.plot([], [], color=color, lw=4, label=plain_text(str(names[int(index)])))
    axes.set_aspect("equal")
    axes.autoscale_view()
    if one_color is None:
        axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), ncols=1 + len(present) // 20)
