"""How hard a patient is, told before a procedure from geometry and from the ladder's navigations: `assess_difficulty`.

A linear model tells the time and the exposures that a target will take from the ladder's 240 navigations by `agent`:
log y = b₀ + b₁ log length + b₂ turning + b₃ forks. `difficulty.csv` holds these navigations; docs/figures/difficulty.py
makes it of a run. The interval of 80 % is that of the residuals of each task under a fit to the other eleven: it holds
for a kind of vessel that the fit has not seen.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, astuple, dataclass
from functools import cache
from importlib.resources import files
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float

from endopilot.control.reach import forks
from endopilot.devices.device import Wire, lateral_reach
from endopilot.settings import public
from endopilot.tasks.route import Route
from endopilot.types import Anatomy, VesselTree

NAVIGATIONS_FILE = "difficulty.csv"
INTERVAL = (0.1, 0.9)
"""Quantiles between which an interval of 80 % lies."""
_CHORD_MM = 5.0
"""A direction is that of a chord as long, mm: the turning of a centerline's own noise stays out."""
_SHAPE, _MEASURES = ["length_mm", "turning_deg", "forks"], ("exposures", "seconds")
_UNTOLD = dict.fromkeys(f"{measure}{end}" for measure in _MEASURES for end in ("", "_from", "_to"))


@dataclass(frozen=True)
class Shape:
    """What of a route makes it hard.

    Attributes:
        length_mm: from the ostium to the target, mm.
        turning_deg: how far the route turns in all, by chords of 5 mm, degrees.
        forks: places where branches part before the target.
    """

    length_mm: float
    turning_deg: float
    forks: int

    @staticmethod
    def of(route: Route) -> Shape:
        """Return the shape of a route."""
        along = np.arange(0.0, route.target.abscissa, _CHORD_MM)
        points = np.stack([route.position(abscissa) for abscissa in (*along, route.target.abscissa)])
        chords = np.diff(points, axis=0)
        chords = chords[np.linalg.norm(chords, axis=1) > 0]
        chords = chords / np.linalg.norm(chords, axis=1, keepdims=True)
        turning = np.degrees(np.arccos(np.clip((chords[:-1] * chords[1:]).sum(axis=1), -1.0, 1.0))).sum()
        return Shape(route.target.abscissa, float(turning), len(route.junctions))


@public
def assess_difficulty(anatomy: Anatomy, wire: Wire, *, places: Sequence[str] = ()) -> list[dict[str, Any]]:
    """Return how hard each section of a vessel is to reach, the easiest first.

    Args:
        anatomy: the patient.
        wire: what is to go there, alone.
        places: targets, as `Anatomy.target` takes them; the middles of all sections by default.

    Returns:
        A row a section: `section`; length, turning and forks of the route (`Shape`); `bore_mm`, by how much the
        narrowest place is wider than the wire; `tip_reaches`, the largest share of a fork's free width that the tip
        reaches to the side, at the fork where that is least (1: the tip enters from however it lies); `exposures` and
        `seconds` that are expected, each with its interval of 80 % (`_from`, `_to`). What lies behind a place narrower
        than the wire has none. `extrapolated`: the route is longer, or has more turns or forks, than all of the ladder.

    Raises:
        InputError: nothing is named, or what does not lie in the vessel.
    """
    rows = []
    for place in places or anatomy.tree.sections_present:
        route = Route.to(anatomy, anatomy.target(place))
        shape = Shape.of(route)
        bore_mm = 2 * float(route.line.radius[route.line.abscissa <= route.target.abscissa].min()) - wire.diameter_mm
        tip_mm = lateral_reach(wire.tip_bend_rad, wire.tip_bend_length_mm)
        reaches = [tip_mm / fork.width_mm for fork in forks(route, wire) if fork.width_mm > 0]
        row = {"section": place, **asdict(shape), "bore_mm": bore_mm, "tip_reaches": float(min([1.0, *reaches]))}
        row["extrapolated"] = bool(np.any(np.array(astuple(shape)) > _navigations()[_SHAPE].max()))
        rows.append(row | (expected(shape) if bore_mm > 0 else _UNTOLD))
    return sorted(rows, key=lambda row: row["seconds"] or np.inf)


def expected(shape: Shape) -> dict[str, float]:
    """Return `exposures` and `seconds` of a navigation along a route of some shape, with intervals of 80 %."""
    found = {}
    for measure in _MEASURES:
        weights, spread = _fit(measure)
        middle = float(_features([shape])[0] @ weights)
        values = np.exp(middle + np.array([0.0, *spread]))
        found |= dict(zip((measure, f"{measure}_from", f"{measure}_to"), values.tolist(), strict=True))
    return found


def arch_type(tree: VesselTree) -> str | None:
    """Return the type of an aortic arch, I, II or III; None where the tree is none, or lacks the arteries.

    By how far the origin of the brachiocephalic trunk lies below the top of the arch, in diameters of the left common
    carotid artery: up to one, up to two, more (Madhwal S et al., J Invasive Cardiol 2008;20:538).
    """
    begins: dict[str, int] = {}
    for index, branch in enumerate(tree.branches):
        begins.setdefault(tree.section_names[int(branch.section[-1])], index)
    if not {"aortic arch", "brachiocephalic trunk", "left common carotid"} <= begins.keys():
        return None
    arch = np.array([tree.section_names[int(s)] == "aortic arch" for b in tree.branches for s in b.section])
    trunk, carotid = (tree.branches[begins[n]].centerline for n in ("brachiocephalic trunk", "left common carotid"))
    drop_mm = float(tree.line.points[arch, 2].max() - trunk.points[0, 2])
    wide_mm = 2 * float(np.quantile(carotid.radius, 0.75))  # neither the mouth in the aorta nor a stenosis
    diameters = drop_mm / wide_mm
    return "I" if diameters <= 1 else "II" if diameters <= 2 else "III"


def _features(shapes: Sequence[Shape]) -> Float[np.ndarray, "n 4"]:
    return np.array([(1.0, np.log(each.length_mm), np.radians(each.turning_deg), each.forks) for each in shapes])


@cache
def _navigations() -> pd.DataFrame:
    return pd.read_csv(str(files("endopilot.control") / NAVIGATIONS_FILE))


@cache
def _fit(measure: str) -> tuple[Float[np.ndarray, "4"], Float[np.ndarray, "2"]]:
    """Return the weights of the model of a measure, and the quantiles of its residuals, task by task left out."""
    table = _navigations()
    features = _features([Shape(*row) for row in table[_SHAPE].itertuples(index=False)])
    logs, tasks = np.log(table[measure].to_numpy(dtype=float)), table["task"].to_numpy()
    residuals = []
    for task in np.unique(tasks):
        own = tasks == task
        weights = np.linalg.lstsq(features[~own], logs[~own])[0]
        residuals.append(logs[own] - features[own] @ weights)
    spread = np.quantile(np.concatenate(residuals), INTERVAL)
    return np.linalg.lstsq(features, logs)[0], spread
