"""A picture of a log's replay: the real tip beside the simulated one, in the plane and along the vessel over time."""

from __future__ import annotations

from collections.abc import Sequence

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from endopilot.plotting import BLACK, GREY, ORANGE, STYLE, VERMILLION
from endopilot.robot.replay import EpisodeReplay
from endopilot.types import Anatomy

MOST_SHOWN = 4  # episodes that one picture shows, evenly chosen from all
_SPARE_MM = 4.0


def replay_figure(anatomy: Anatomy, found: Sequence[EpisodeReplay], title: str) -> Figure:
    """Draw some episodes, each beside its course over time."""
    chosen = np.unique(np.linspace(0, len(found) - 1, min(MOST_SHOWN, len(found))).round().astype(int))
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(11, 3.1 * len(chosen)), layout="constrained", facecolor="white")
        panels = np.atleast_2d(figure.subplots(len(chosen), 2, width_ratios=(1.0, 1.8)))
        for row, k in enumerate(chosen):
            _draw_plane(panels[row, 0], anatomy, found[k])
            _draw_course(panels[row, 1], found[k])
        figure.suptitle(title, x=0.01, ha="left")
        figure.legend(*panels[0, 1].get_legend_handles_labels(), loc="outside lower right", ncols=4)
        for axes in panels[:-1].ravel():
            axes.set_xlabel("")
    return figure


def _draw_plane(axes: Axes, anatomy: Anatomy, episode: EpisodeReplay) -> None:
    across, up = anatomy.tree.widest_axes()
    anatomy.plot(axes=axes, color="#dfe3e8")
    axes.plot(episode.seen[:, across], episode.seen[:, up], ".", color=BLACK, ms=3)
    given, rest = episode.simulated[episode.given], episode.predicted[~episode.given]
    axes.plot(given[:, across], given[:, up], color=ORANGE, lw=1.3)
    axes.plot(rest[:, across], rest[:, up], color=VERMILLION, lw=1.3)
    both = np.concatenate([episode.seen, episode.simulated])[:, [across, up]]
    low, high = both.min(axis=0) - _SPARE_MM, both.max(axis=0) + _SPARE_MM
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), title=f"episode {episode.number}")


def _draw_course(axes: Axes, episode: EpisodeReplay) -> None:
    time_s = episode.time_s - episode.time_s[0]
    rest = ~episode.given
    axes.plot(time_s, episode.driven, color=GREY, ls="--", lw=1.2, label="drive without vessel")
    axes.plot(time_s, episode.abscissa[:, 0], ".", color=BLACK, ms=3, label="real tip")
    axes.plot(time_s[episode.given], episode.abscissa[episode.given, 1], color=ORANGE, lw=1.4, label="simulated, given")
    axes.plot(time_s[rest], episode.abscissa[rest, 1], color=VERMILLION, lw=1.4, label="predicted")
    errors = episode.errors
    axes.set(xlabel="time, s", ylabel="tip along the vessel Δtip, mm")
    axes.set_title(
        f"predicted: {errors['along']:.2f} mm along, {errors['across']:.2f} mm across", fontsize=9, fontweight="normal"
    )
