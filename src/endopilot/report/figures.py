"""The figures of an evaluation, a report and a log's replay, and the tables of what an evaluation's draw, which are
written beside them as CSV; `titles` says what a reader calls each split."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from textwrap import fill
from typing import Any

import matplotlib
import numpy as np
import pandas as pd
from jaxtyping import Shaped
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from endopilot.anatomy.projection import safety_ratio
from endopilot.evaluation.metrics import control_rmse, mean_over_time, quantiles_over_time
from endopilot.evaluation.results import CONTROL_BASELINES, SERIES_TITLES, TIP_BASELINES, SplitResult
from endopilot.imaging.overlay_picture import draw_slices
from endopilot.plotting import BLACK, BLUE, GREEN, GREY, ORANGE, SKY, STYLE, VERMILLION
from endopilot.robot.kinematics import evenly
from endopilot.robot.replay import EpisodeReplay
from endopilot.types import Anatomy, LumenMask, Volume

SERIES_STYLE: dict[str, dict] = {
    "true": {"color": BLACK, "label": "Recorded"},
    "P1": {"color": BLUE},
    "P2": {"color": BLUE},
    "P3": {"color": ORANGE},
    "P4": {"color": VERMILLION},
    "P2_replayed": {"color": SKY},
    "hold_slack": {"color": GREY, "linestyle": "--"},
    "training_mean": {"color": GREY, "linestyle": ":"},
    "hold_control": {"color": "#5d4a3a", "linestyle": "-."},
    "follow_slack": {"color": GREEN, "linestyle": "--"},
}


MOST_SHOWN = 4  # episodes of a replay that one picture shows, evenly chosen from all
_SPARE_MM = 4.0
SAFETY_SERIES = ("true", "P3", "P4")


def tip_error_table(results: Mapping[str, SplitResult]) -> pd.DataFrame:
    """Return the mean |error| of Δtip and γtip over the sequences, mm, for each split, series and time."""
    pieces = []
    for split, result in results.items():
        for series in _ordered(result.tips, [name for key, names in TIP_BASELINES.items() for name in (key, *names)]):
            means = {
                f"{coordinate}_mae_mm": mean_over_time(result.error(series, coordinate))
                for coordinate in ("abscissa", "offset")
            }
            pieces.append(pd.DataFrame({"split": split, "series": series, "time_s": result.time_s, **means}))
    return pd.concat(pieces, ignore_index=True)


def safety_table(results: Mapping[str, SplitResult]) -> pd.DataFrame:
    """Return quantiles over the sequences of γ/r ("radius") and γ/(r − r_w) ("clearance") against time."""
    pieces = []
    for split, result in results.items():
        for series in _ordered({"true": None, **result.tips}, SAFETY_SERIES):
            tip = result.true if series == "true" else result.tips[series]
            for ratio, wire_radius in (("radius", 0.0), ("clearance", result.wire_radius_mm)):
                values = quantiles_over_time(safety_ratio(tip.offset, tip.radius, wire_radius))
                keys = {"split": split, "series": series, "ratio": ratio, "time_s": result.time_s}
                pieces.append(pd.DataFrame({**keys, **values}))
    return pd.concat(pieces, ignore_index=True)


def control_error_table(results: Mapping[str, SplitResult]) -> pd.DataFrame:
    """Return the RMSE of each sequence's controls, in mm/s and deg/s, for each split and series."""
    pieces = []
    for split, result in results.items():
        for series in _ordered(result.controls, ("P2", *CONTROL_BASELINES)):
            rmse = control_rmse(result.controls[series], result.true_control)
            columns = {"translation_rmse_mm_s": rmse[:, 0], "rotation_rmse_deg_s": rmse[:, 1]}
            anatomy = [result.anatomies[index] for index in result.anatomy]
            keys = {"split": split, "series": series, "anatomy": anatomy, "sequence": result.sequence}
            pieces.append(pd.DataFrame(keys | columns))
    return pd.concat(pieces, ignore_index=True)


def _groups(table: pd.DataFrame, column: str) -> dict[str, pd.DataFrame]:
    """Return the rows of each value of a column, in the order of their appearance."""
    return {str(name): pd.DataFrame(part) for name, part in table.groupby(column, sort=False)}


def _ordered(available: Mapping[str, Any], order: Sequence[str]) -> list[str]:
    return [name for name in dict.fromkeys(order) if name in available]


def tip_error_figure(table: pd.DataFrame, titles: Mapping[str, str]) -> Figure:
    """Draw the mean |error| of Δtip and γtip against time, one row a split (`tip_error_table`)."""
    splits = _groups(table, "split")
    panels = (("abscissa_mae_mm", "Mean |error| of Δtip, mm"), ("offset_mae_mm", "Mean |error| of γtip, mm"))
    with matplotlib.rc_context(STYLE):
        figure, axes = _grid(len(splits), 2, height=3.0)
        for row, (split, part) in zip(axes, splits.items(), strict=True):
            for ax, (column, label) in zip(row, panels, strict=True):
                for series, line in _groups(part, "series").items():
                    ax.plot(line["time_s"], line[column], **_style(series))
                ax.set(xlabel="Time after the given states, s", ylabel=label, xlim=(0, None))
                ax.set_ylim(0, _upper(part, column))
                ax.set_title(titles[split])
        _legend_below(figure, axes)
    return figure


def safety_figure(table: pd.DataFrame, titles: Mapping[str, str]) -> Figure:
    """Draw γ/(r − r_w), below it γ/r, against time, a column a split, with median, quartiles and 95 % quantile."""
    splits = _groups(table, "split")
    plate = {"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 1.0}
    ratios = (("clearance", "γ / (r − r_w)", "the wire touches"), ("radius", "γ / r", "the wire's axis on the wall"))
    with matplotlib.rc_context(STYLE):
        figure, axes = _grid(len(ratios), len(splits), height=3.2)
        for row, (ratio, label, wall) in zip(axes, ratios, strict=True):
            highest = _upper(_groups(table, "ratio")[ratio], "p95")
            for ax, (split, part) in zip(row, splits.items(), strict=True):
                for series, line in _groups(_groups(part, "ratio")[ratio], "series").items():
                    time, style = line["time_s"], _style(series)
                    ax.fill_between(time, line["q25"], line["q75"], color=style["color"], alpha=0.16, lw=0)
                    ax.plot(time, line["median"], **style)
                    ax.plot(time, line["p95"], color=style["color"], lw=0.8, ls="-")
                ax.axhline(1.0, color=BLACK, lw=1.0, ls=(0, (4, 3)))
                at = {"xycoords": ("axes fraction", "data"), "ha": "right", "va": "bottom"}
                ax.annotate(wall, (0.995, 1.0), size=8.5, bbox=plate, **at)
                ax.set(xlabel="Time after the given states, s", ylabel=f"Safety ratio {label}", xlim=(0, None))
                ax.set_ylim(0, float(np.clip(highest, 1.25, 1.5)))
                ax.set_title(titles[split])
        axes[0, 0].fill_between([], [], [], color=GREY, alpha=0.3, lw=0, label="Quartiles")
        axes[0, 0].plot([], [], color=GREY, lw=0.8, label="95 % quantile")
        _legend_below(figure, axes)
    return figure


def control_error_figure(table: pd.DataFrame, titles: Mapping[str, str]) -> Figure:
    """Draw the control RMSE of the sequences (`control_error_table`), a row a split, a box a series: median,
    quartiles, and whiskers from the 5 % to the 95 % quantile."""
    panels = (("translation_rmse_mm_s", "Translation RMSE, mm/s"), ("rotation_rmse_deg_s", "Rotation RMSE, deg/s"))
    splits, series = _groups(table, "split"), [*_groups(table, "series")]
    names = [fill(_style(name)["label"].removeprefix("Baseline: "), 27) for name in series]
    with matplotlib.rc_context(STYLE):
        figure, axes = _grid(len(splits), len(panels), height=0.9 + 0.55 * len(series))
        for row, (split, part) in zip(axes, splits.items(), strict=True):
            for ax, (column, label) in zip(row, panels, strict=True):
                drawn = ax.boxplot(
                    [part.loc[part["series"] == name, column].dropna() for name in series],
                    orientation="horizontal",
                    whis=(5, 95),
                    showfliers=False,
                    patch_artist=True,
                    tick_labels=names if ax is row[0] else [""] * len(series),
                    medianprops={"color": BLACK},
                )
                for box, name in zip(drawn["boxes"], series, strict=True):
                    box.set_facecolor(_style(name)["color"])
                ax.set(xlabel=label, xlim=(0, None), title=titles[split])
                ax.invert_yaxis()
    return figure


def volume_figure(volume: Volume, mask: LumenMask, anatomy: Anatomy) -> Figure:
    """Draw the CTA around a vessel with the outline of its mask, in slices through the ostium, and the extracted
    tree."""
    ostium = mask.ostium or anatomy.insertion
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(11.5, 3.9), layout="constrained")
        axes = figure.subplots(1, 3)
        draw_slices(axes[:2], volume, [(mask, VERMILLION)], through=ostium.position)
        anatomy.plot(axes=axes[2], view="front")
        axes[2].set_title("Extracted centerline")
    return figure


def tree_figure(anatomy: Anatomy) -> Figure:
    """Draw the extracted tree alone, where there is no CT."""
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(6.0, 4.2), layout="constrained")
        anatomy.plot(axes=figure.subplots(), view="front")
    return figure


def replay_figure(anatomy: Anatomy, found: Sequence[EpisodeReplay], title: str) -> Figure:
    """Draw some episodes of a log's replay, the real tip beside the simulated one, in the plane and over time."""
    chosen = evenly(len(found), MOST_SHOWN)
    with matplotlib.rc_context(STYLE):
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


def _grid(rows: int, columns: int, *, height: float) -> tuple[Figure, Shaped[np.ndarray, "rows columns"]]:
    figure = Figure(figsize=(5.2 * columns if columns > 1 else 7.0, height * rows), layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False)


def _style(series: str) -> dict[str, Any]:
    return {"color": GREY, "label": SERIES_TITLES.get(series, series)} | SERIES_STYLE.get(series, {})


def _upper(table: pd.DataFrame, column: str) -> float:
    """Return an upper limit that shows every series whole, unless one runs away from all others."""
    series = [float(line[column].to_numpy().max()) for line in _groups(table, "series").values()]
    highest = sorted(value for value in series if np.isfinite(value))
    if not highest:
        return 1.0
    return 1.08 * min(highest[-1], 1.5 * highest[max(len(highest) - 2, 0)]) + 1e-6


def _legend_below(figure: Figure, axes: Shaped[np.ndarray, "rows columns"]) -> None:
    entries = {label: handle for ax in axes.flat for handle, label in zip(*ax.get_legend_handles_labels(), strict=True)}
    columns = min(len(entries), 3)
    figure.legend(list(entries.values()), list(entries), loc="outside lower center", ncols=max(columns, 1))
