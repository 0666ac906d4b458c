"""Draw the picture of docs/evidence/bench.md: an aorto-iliac path before and after stiff wires."""

from __future__ import annotations

import sys
import warnings
from pathlib import Path

import matplotlib as mpl
import numpy as np

sys.path.append(str(Path(__file__).parents[2]))  # where `benchmarks` is

from benchmarks.published.straightening import WIRES_GPA, draw_path, stiff_wire, straighten
from endopilot.plotting import BLACK, GREEN, GREY, ORANGE, SKY, STYLE, VERMILLION

mpl.use("Agg")
import matplotlib.pyplot as plt

PICTURE = Path(__file__).parents[1] / "images" / "bench-straightening.png"
DRAW = 4
"""Which of the paths of `python -m benchmarks published` is drawn."""


def main() -> None:
    """Draw the axis of the arteries from two sides, and by how much it is displaced."""
    path = draw_path(np.random.default_rng([0, 2, DRAW]))
    anatomy = path.anatomy()
    plt.rcParams.update(STYLE)
    figure, (front, side, along) = plt.subplots(
        1, 3, figsize=(9, 4.6), layout="constrained", width_ratios=(1, 0.8, 1.6)
    )
    for axes, across in ((front, 0), (side, 1)):
        axes.plot(path.iliac_mm[:, across], path.iliac_mm[:, 2], color=BLACK, label="no wire")
        axes.plot(path.aorta_mm[:60, across], path.aorta_mm[:60, 2], color=GREY, linewidth=1)
        axes.set(aspect="equal", xlabel=f"{'xy'[across]}, mm", ylim=(-130, 50))
    for (name, modulus), colour in zip(WIRES_GPA.items(), (SKY, GREEN, ORANGE, VERMILLION), strict=True):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # these wires press harder than a navigation's may
            found = straighten(path, anatomy, stiff_wire(modulus, friction=path.friction))
        for axes, across in ((front, 0), (side, 1)):
            axes.plot(found.axis_mm[:, across], found.axis_mm[:, 2], color=colour)
        step = np.linalg.norm(np.diff(found.axis_mm, axis=0), axis=1)
        place = np.append(0, np.cumsum(step))
        along.plot(place, found.moved_mm, color=colour, label=f"{name}, {modulus:g} GPa")
    front.set(ylabel="z, mm", title="front")
    front.legend()
    side.set(title="side")
    along.set(xlabel="length of the displaced axis, from the bifurcation on, mm", ylabel="displacement, mm")
    along.set_ylim(0, 16)
    along.legend()
    figure.savefig(PICTURE, dpi=90)


if __name__ == "__main__":
    main()
