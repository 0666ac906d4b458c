"""Left coronary arteries: left main, anterior descending and circumflex with their branches, by dominance.

Facts and their sources: mean courses and origins of branches, Dodge JT et al., Circulation 1988;78:1167-80 (see
`heart_reference`); lumen diameters by dominance and sex, Dodge JT et al., Circulation 1992;86:232-46 (left
main 4.5 ± 0.5 mm, anterior descending 3.7 ± 0.4 to 1.9 ± 0.4 mm, circumflex 3.4 ± 0.5 mm, 4.2 ± 0.6 mm where it is
dominant); left main 13.1 mm long and the circumflex most often 65 to 80 mm, a cadaver study of 80 hearts from Gujarat
(docs/evidence/atlas.md), where the SD of the left main's length, 2.4 mm, is smaller than the 5.2 mm of Reig J, Petit M,
Clin Anat 2004;17:6-13: drawn with 3.5 mm.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from jaxtyping import Float
from scipy.interpolate import PchipInterpolator
from scipy.spatial.transform import Rotation

from endopilot.anatomy.labels_tree import LCA_SECTIONS
from endopilot.atlas import branching
from endopilot.atlas import curves as shape
from endopilot.atlas.heart_reference import FORK, INFERIOR, LAD, LCX, HeartFit, fit_left_heart
from endopilot.atlas.population import Draw, Drawn, SideKind, side_kinds
from endopilot.atlas.variation import bent, drawn_from, ectasia, factor, forks_of, opened_fork, varied
from endopilot.lines import length_along

LEFT_MAIN_MM, LEFT_MAIN_SD_MM, LEFT_MAIN_DIAMETER_MM = 13.1, 3.5, 4.5
LAD_DIAMETER_MM = {0.0: 3.7, 0.06: 3.6, 0.24: 2.5, 0.58: 1.7, 0.79: 1.4, 0.84: 1.25, 1.0: 1.1}
"""Lumen diameter, mm, along the anterior descending artery's whole course (Dodge 1992: L1p, L1m, L2m, L3m, L4p and on
to the end of L4)."""
LCX_DIAMETER_MM = {
    "right": {0.0: 3.4, 0.25: 3.0, 0.6: 2.2, 1.0: 1.3},
    "balanced": {0.0: 3.6, 0.25: 3.2, 0.6: 2.5, 1.0: 1.6},
    "left": {0.0: 4.2, 0.25: 3.9, 0.5: 3.1, 0.65: 2.4, 1.0: 1.6},
}
"""The same along the circumflex artery from its origin to its end, by dominance."""

_SIZE_SD, _TURN_SD_DEG, _WIGGLE_MM = 0.085, 6.0, (0.5, 1.3)
"""Spread of the heart's size, of its position about each axis (from the SD of Dodge's positions), of the wiggles."""

_ENDS = {"right": (66.0, 9.0, 40.0, 76.0), "balanced": (88.0, 4.0, 82.0, 97.0)}
"""Length of the circumflex artery, mm: mean, SD, least, most, in a heart of mean size. A left-dominant one goes on over
the crux into the posterior descending artery."""


_ORDERED = (("9", "10"), ("12",))  # first branches of the LAD and of the circumflex, septals aside
_FLARE_MM = 3.0  # over this length before and behind its fork the left main artery widens, mm
_SHARPEST_PER_MM = 0.45  # greatest curvature of the main vessels, 1/mm


@dataclass(frozen=True, eq=False)
class _Trunk:
    """A patient's main vessels: courses from the ostium and from the fork as far as they could go, the number of points
    there, indices of fork and crux, size and position of the heart."""

    whole_lad: Float[np.ndarray, "n 3"]
    whole_lcx: Float[np.ndarray, "m 3"]
    counts: tuple[int, int]
    fork: int
    crux: int
    size: float
    turn: Rotation

    @property
    def lad(self) -> Float[np.ndarray, "k 3"]:
        """The left main and anterior descending artery."""
        return self.whole_lad[: self.counts[0]]

    @property
    def lcx(self) -> Float[np.ndarray, "k 3"]:
        """The circumflex artery."""
        return self.whole_lcx[: self.counts[1]]

    def heart(self) -> HeartFit:
        """Fit the reference heart to the courses."""
        return fit_left_heart(self.whole_lad, self.whole_lcx[: self.crux + 1], self.whole_lcx[self.crux :])


def make_lca(draw: Draw) -> Drawn:
    """Return one left coronary tree and what was drawn for it; a stenosis lies in either of its main branches."""
    dominance = branching.coronary_dominance(draw.generator.random())
    # Drawn once, so that shapes that fail do not bias it.
    main_mm = None if draw.population.left_main_mm is None else drawn_from(draw, draw.population.left_main_mm)
    return branching.until_it_fits("left coronary artery", _draw, draw, dominance, main_mm)


def _draw(draw: Draw, dominance: str, main_mm: float | None) -> Drawn:
    trunk = _trunk(draw, dominance, main_mm)
    calibre = branching.coronary_calibre(draw, 1.0, 0.65, 1.4)
    lad = _lad(draw, trunk, calibre)
    flare = factor(draw, draw.population.left_main_flare) - 1
    if flare:
        away = (length_along(trunk.lad) - shape.STEP_MM * trunk.fork) / _FLARE_MM
        lad = replace(lad, radius=lad.radius * (1 + flare * np.exp(-(away**2))))
    wide, widening = ectasia(draw, length_along(trunk.lad))
    lad = replace(lad, radius=lad.radius * widening)
    vessels, narrow = [lad, _lcx(draw, trunk, lad, dominance, calibre)], []
    plans = varied(draw, _plan_branches(draw, trunk, vessels, dominance, calibre))
    trunk = _bent(draw, trunk, vessels, plans)
    heart = trunk.heart()
    plans = [plan if plan.section == "septal" else replace(plan, depth=heart.solid_depth) for plan in plans]
    vessels = [replace(vessels[0], points=trunk.lad), replace(vessels[1], points=trunk.lcx)]
    vessels = _with_sections(trunk, vessels, plans, dominance)
    lad = vessels[0]
    if draw.generator.random() < draw.stenosis_share:
        fork = trunk.fork / len(lad.points)
        which, shares = (0, (fork + 0.06, 0.65)) if draw.generator.random() < 0.6 else (1, (0.15, 0.6))
        narrow, vessels = branching.narrowed(draw, vessels, which, shares)
    vessels = branching.with_side_branches(draw, vessels, plans)
    tree = branching.build_tree(vessels, LCA_SECTIONS)
    along, bends = length_along(lad.points), shape.curvature(lad.points)
    drawn = {
        "dominance": dominance,
        "ramus": any(plan.section == "17" for plan in plans),
        "length_mm": float(along[-1]),
        "left_main_length_mm": float(along[trunk.fork]),
        "circumflex_length_mm": float(length_along(vessels[1].points)[-1]),
        "tortuosity": shape.tortuosity(lad.points),
        "curvature_mean_per_mm": float(bends.mean()),
        "curvature_p90_per_mm": float(np.quantile(bends, 0.9)),
        "stenoses": narrow,
        "ectasias": wide,
    }
    return tree, drawn


@cache
def _templates() -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "m 3"]]:
    lcx = np.concatenate([LCX, INFERIOR[1:]])
    return shape.curve_through(LAD, 1.0), shape.curve_through(lcx, 1.0)


def _trunk(draw: Draw, dominance: str, main_mm: float | None) -> _Trunk:
    """Return the main vessels: the mean courses, sized, turned, moved with the left main's end, and wiggling."""
    size = float(np.exp(_SIZE_SD * np.clip(draw.generator.normal(), -2.5, 2.5)))
    turn = Rotation.from_rotvec(np.deg2rad(draw.generator.normal(0, _TURN_SD_DEG, 3)))
    if main_mm is None:
        main_mm = branching.truncated(draw, LEFT_MAIN_MM, LEFT_MAIN_SD_MM, 5.0, 22.0)
    lad, lcx = ((template - template[0]) * size for template in _templates())
    end_of_main = main_mm * FORK / np.linalg.norm(FORK)
    bow = np.array([[0.0, 0.0, 0.0], 0.5 * end_of_main + main_mm * np.array([0.0, 0.06, 0.08])])
    stride = round(6.0 * size)
    lad = branching.wiggled(
        draw, shape.curve_through(np.concatenate([bow, lad[::stride] + end_of_main])), _WIGGLE_MM, quiet_mm=9.0
    )
    fork = round(main_mm / shape.STEP_MM)
    crux_at = (LCX[-1] - FORK) * size
    lcx = branching.wiggled(draw, shape.curve_through(lcx[::stride]), _WIGGLE_MM, quiet_mm=7.0)
    crux = int(np.argmin(np.linalg.norm(lcx - crux_at, axis=1)))
    lad, lcx = turn.apply(lad), turn.apply(lcx + lad[fork])
    if draw.population.left_main_turns_deg is not None:
        wide = 0.5 * LEFT_MAIN_DIAMETER_MM
        lad, lcx = opened_fork(draw, lad, lcx, fork, wide, draw.population.left_main_turns_deg)
    if dominance == "left":
        end_mm = shape.STEP_MM * crux + size * branching.truncated(draw, 48.0, 10.0, 28.0, 68.0)
    else:
        end_mm = size * branching.truncated(draw, *_ENDS[dominance])
    # The anterior descending artery ends before, at or beyond the apex.
    last = fork + round((len(lad) - 1 - fork) * draw.generator.uniform(0.74, 1.0))
    trunk = _Trunk(lad, lcx, (last + 1, round(end_mm / shape.STEP_MM) + 1), fork, crux, size, turn)
    if max(shape.curvature(trunk.lad).max(), shape.curvature(trunk.lcx).max()) > _SHARPEST_PER_MM:
        raise branching.NoShape
    return trunk


def _bent(
    draw: Draw,
    trunk: _Trunk,
    vessels: Sequence[branching.Vessel],
    plans: Sequence[branching.SidePlan],
) -> _Trunk:
    if not draw.population.bends_vessels:
        return trunk
    beyond = round(2.5 * float(vessels[0].radius[trunk.fork]) / shape.STEP_MM)
    bent_lines = []
    for index, (line, first) in enumerate(((trunk.whole_lad, trunk.fork + beyond), (trunk.whole_lcx, beyond))):
        radius = vessels[index].radius
        radius = np.concatenate([radius, np.full(max(len(line) - len(radius), 0), radius[-1])])[: len(line)]
        forks = [fork for fork in forks_of(plans, index) if fork.index > first]
        bent_lines.append(bent(draw, line, radius, forks=forks, first=first))
    return replace(trunk, whole_lad=bent_lines[0], whole_lcx=bent_lines[1])


def _lad(draw: Draw, trunk: _Trunk, calibre: float) -> branching.Vessel:
    along = length_along(trunk.lad)
    beyond = along - along[trunk.fork]
    whole = trunk.size * float(length_along(_templates()[0])[-1])
    own = PchipInterpolator(list(LAD_DIAMETER_MM), list(LAD_DIAMETER_MM.values()))(np.clip(beyond / whole, 0, 1))
    # The left main's lumen changes into that of the anterior descending artery just behind the fork.
    share = np.clip((beyond + 1.0) / 4.0, 0.0, 1.0)
    diameter = LEFT_MAIN_DIAMETER_MM + (own - LEFT_MAIN_DIAMETER_MM) * share**2 * (3 - 2 * share)
    return branching.Vessel(trunk.lad, 0.5 * diameter * calibre * branching.uneven(draw, along), ())


def _lcx(draw: Draw, trunk: _Trunk, lad: branching.Vessel, dominance: str, calibre: float) -> branching.Vessel:
    along = length_along(trunk.lcx)
    profile = LCX_DIAMETER_MM[dominance]
    own = PchipInterpolator(list(profile), list(profile.values()))(along / along[-1])
    radius = np.minimum(0.5 * own * calibre * branching.uneven(draw, along), lad.radius[trunk.fork])
    forward = shape.tangents(trunk.lad)[trunk.fork]
    radius = branching.mouth(radius, trunk.lcx, forward, float(lad.radius[trunk.fork]))
    return branching.Vessel(trunk.lcx, radius, (), 0, trunk.fork)


def _plan_branches(
    draw: Draw,
    trunk: _Trunk,
    vessels: list[branching.Vessel],
    dominance: str,
    calibre: float,
) -> list[branching.SidePlan]:
    plans: list[branching.SidePlan] = []
    presence = factor(draw, draw.population.side_share)
    for parent, kinds in enumerate((side_kinds("lca", "lad"), side_kinds("lca", "lcx"))):
        first = trunk.fork if parent == 0 else 0
        taken: list[int] = []
        for name, kind in kinds.items():
            if draw.generator.random() > kind.share * presence or (name == "14 posterior" and dominance == "right"):
                continue
            mean, sd = (trunk.size * value for value in kind.origin_mm)
            origin = first + branching.free_origin(draw, mean, sd, taken)
            if origin * shape.STEP_MM > length_along(vessels[parent].points)[-1] - 8.0:
                continue
            taken.append(origin - first)
            plans.append(_plan(draw, name.split()[0], kind, parent, origin, trunk, calibre))
        own = sorted(
            (plan for plan in plans if plan.parent == parent and plan.section != "septal"), key=lambda plan: plan.origin
        )
        named = {id(plan): name for plan, name in zip(own, _ORDERED[parent], strict=False)}
        plans = [replace(plan, section=named.get(id(plan), plan.section)) for plan in plans]
    ramus = side_kinds("lca", "ramus")["17"]
    if draw.generator.random() < ramus.share:
        plans.insert(0, _plan(draw, "17", ramus, 0, trunk.fork, trunk, calibre))
    return plans


def _plan(
    draw: Draw,
    section: str,
    kind: SideKind,
    parent: int,
    origin: int,
    trunk: _Trunk,
    calibre: float,
) -> branching.SidePlan:
    mean, sd = kind.length_mm
    septal = section == "septal"
    return branching.SidePlan(
        section=section,
        parent=parent,
        origin=origin,
        length_mm=trunk.size * branching.truncated(draw, mean, sd, 0.5 * mean, 1.5 * mean),
        diameter_mm=kind.diameter_mm * (0.6 + 0.4 * calibre) * (1 + 0.1 * float(draw.generator.normal())),
        courses=tuple((begin, tuple(trunk.turn.apply(course))) for begin, course in kind.courses),
        angle_deg=(60.0, 90.0) if septal else (40.0, 70.0),
    )


def _with_sections(
    trunk: _Trunk, vessels: list[branching.Vessel], plans: list[branching.SidePlan], dominance: str
) -> list[branching.Vessel]:
    """Name the points of the two main vessels (SCCT), without branches by the lengths of `labels_coronary`."""
    lad, lcx = vessels
    place = np.arange(len(lad.points))
    apex = int(np.argmax(np.linalg.norm(lad.points - lad.points[trunk.fork], axis=1)))
    sides = [plan.origin for plan in plans if plan.parent == 0 and plan.origin > trunk.fork]
    proximal = min(sides, default=trunk.fork + (apex - trunk.fork) // 3)
    ends = [place <= trunk.fork, place <= proximal, place <= (proximal + apex) / 2]
    names = np.select(ends, ["5", "6", "7"], default="8").tolist()
    marginals = [plan.origin for plan in plans if plan.parent == 1]
    place = np.arange(len(lcx.points))
    crux = trunk.crux if dominance == "left" else len(place)
    ends = [place <= min(marginals, default=len(place) // 2), place <= crux]
    return [replace(lad, section=names), replace(lcx, section=np.select(ends, ["11", "13"], default="15").tolist())]
