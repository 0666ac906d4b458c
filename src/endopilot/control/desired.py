"""Desired tip states over time: along a route at a constant speed, or from a CSV."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
from jaxtyping import Float

from endopilot.errors import InputError
from endopilot.simulation.csv_file import read_columns
from endopilot.tasks.navigation import DECISION_PERIOD_S, Target
from endopilot.tasks.route import Route
from endopilot.tasks.targets import find_target
from endopilot.types import Anatomy

_MARGIN_S = 5.0
"""Time that desired tips rest at the target, s."""


def read_tips(path: Path, fastest_mm_s: float, start_mm: float) -> pd.DataFrame:
    """Read desired tip states: columns time_s (0.5, 1.0, ...), tip_abscissa_mm, tip_offset_mm and, optional, branch.

    Args:
        path: of the table.
        fastest_mm_s: translation of the drive, mm/s.
        start_mm: Δ at the start, mm.

    Returns:
        A table with columns abscissa, offset and branch (−1 where it is not given), a row a sample period.

    Raises:
        InputError: not such a table, or it asks for the end sooner than the drive can be there; the line names file,
            column, row and mend.
    """
    columns = ("time_s", "tip_abscissa_mm", "tip_offset_mm")
    read = read_columns(path, columns, ["branch"])
    late = np.flatnonzero(np.abs(read.values["time_s"] - DECISION_PERIOD_S * (np.arange(len(read.lines)) + 1)) > 1e-6)
    if len(late):
        raise read.fault(int(late[0]), "time_s", "; count 0.5, 1.0, 1.5, ...")
    for name, least in (("tip_abscissa_mm", 0), ("tip_offset_mm", 0), ("branch", -1)):
        low = np.flatnonzero(read.values.get(name, np.zeros(0)) < least)
        if len(low):
            raise read.fault(int(low[0]), name, f"; give {least} or more")
    table = pd.DataFrame({"branch": -1.0, **read.values}, index=range(len(read.lines)))
    length_mm, seconds = float(table["tip_abscissa_mm"].iloc[-1]) - start_mm, DECISION_PERIOD_S * len(table)
    if length_mm > fastest_mm_s * seconds:
        raise InputError(
            f"{path}: {seconds:g} s are too few for the {length_mm:.0f} mm to the last tip at the device's "
            f"{fastest_mm_s:g} mm/s; give rows up to {length_mm / fastest_mm_s:.1f} s or more"
        )
    return table.rename(columns={"tip_abscissa_mm": "abscissa", "tip_offset_mm": "offset"})


def last_place(anatomy: Anatomy, tips: pd.DataFrame, target: str) -> Target:
    """Return the place of the last desired tip, on its branch or else on the longest path.

    Raises:
        InputError: it lies outside the tree.
    """
    tree, branch, abscissa = anatomy.tree, int(tips["branch"].iloc[-1]), float(tips["abscissa"].iloc[-1])
    if branch < 0:
        branch = [b for b in tree.route(tree.longest_leaf()) if tree.branches[b].centerline.abscissa[0] <= abscissa][-1]
    try:
        return find_target(tree, Target(branch=branch, abscissa=abscissa))
    except InputError as error:
        raise InputError(f"{target}: the last tip: {error}; correct tip_abscissa_mm or branch") from None


def tips_along(
    route: Route, wire_radius_mm: float, *, start_mm: float, speed_mm_s: float, seconds: float, safe_ratio: float
) -> Float[np.ndarray, "samples 2"]:
    """Return desired tips that go along a route at some speed, as near to the wall as is safe, and rest at its end.

    Args:
        route: the path to the target.
        wire_radius_mm: of the wire, mm.
        start_mm: Δtip at the start, mm.
        speed_mm_s: mm/s.
        seconds: most time that they take, s.
        safe_ratio: γ/(r − r_w) of the desired tips.
    """
    length_mm = max(route.target.abscissa - start_mm, 0.0)
    periods = int(np.ceil(min(length_mm / speed_mm_s + _MARGIN_S, seconds) / DECISION_PERIOD_S))
    ahead = start_mm + speed_mm_s * DECISION_PERIOD_S * np.arange(1, periods + 1)
    abscissa = np.minimum(ahead, route.target.abscissa)
    room = np.maximum(route.radius(abscissa) - wire_radius_mm, 0.0)
    return np.column_stack([abscissa, safe_ratio * room])
