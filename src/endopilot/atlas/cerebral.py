"""Anterior cerebral circulations: internal carotid artery with its siphon, into middle and anterior cerebral arteries.

Facts and their sources: internal carotid from the cavernous sinus to its end 33.1 ± 6.1 mm long, 5.0 ± 0.6 mm wide at
first and 3.6 ± 0.4 mm at its end, middle cerebral artery 3.1 ± 0.4 mm wide at its origin, 22.5 ± 8.1 mm long and 2.4 ±
0.4 mm wide where M2 begins: 100 CT angiograms, Rai AT et al., J NeuroIntervent Surg 2013;5:371-5. A1 12.7 mm long
(7.2 to 18) and 2.6 mm wide: Perlmutter D, Rhoton AL, J Neurosurg 1976;45:259-72. The middle cerebral artery divides
into two trunks in 78 %, into three in 12 % (Osborn AG, Diagnostic Cerebral Angiography); more than three are left out.
The course: cervical, petrous (vertical, then forwards and inwards), cavernous (forwards, then a knee up and back) and
supraclinoid segment (Bouthillier A et al., Neurosurgery 1996;38:425-32), drawn around mean positions; the siphon's
knees vary by 1 mm. The device enters the high cervical segment. Patients' trunks of M2 part at 97 ± 19° (controls of
1049 screened individuals, University Medical Center Utrecht), and their carotids kink or coil in some 10 % (2856
subjects, echo-Doppler, University of Catania; 4 % and 4 % of 212 arteries, Barfzadeh A et al., Surg Radiol Anat 2024).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy.ndimage import gaussian_filter1d

from endopilot.anatomy.labels_tree import CEREBRAL_SECTIONS
from endopilot.atlas import branching
from endopilot.atlas import curves as shape
from endopilot.atlas.population import Draw, Drawn, vessel_data
from endopilot.atlas.variation import Fork, bent, factor, forks_of, varied
from endopilot.lines import length_along

SIPHON_MM, SIPHON_SD_MM = 33.1, 6.1
M1_MM, M1_SD_MM = 22.5, 8.1
A1_MM, A1_RANGE_MM = 12.7, (7.2, 18.0)
DIAMETER_MM = {"cavernous": 5.0, "terminus": 3.6, "M1": 3.1, "M2": 2.4, "A1": 2.6, "ophthalmic": 1.3, "PCom": 1.4}
TRIFURCATION_SHARE = 12 / 90

_TO_SIPHON = np.array([[0, 0, -30], [1, 0, -15], [0, 0, 0], [-1, -1, 7], [-6, -7, 10.5], [-12, -13, 12.0]])
_SIPHON = np.array(
    [[-16, -16, 19], [-16.5, -21, 22.5], [-16.5, -27, 23], [-16.5, -31, 26.5], [-15.5, -29.5, 31.5], [-15, -25.5, 33.5],
     [-14, -23.5, 38]]
)  # fmt: skip
"""Left internal carotid artery, LPS mm from the entrance of the carotid canal; the midline lies at x = -27."""
_BEYOND_M1 = np.array([[4, 4, 5], [5, 12, 10], [7, 23, 15], [13, 34, 19.0]])  # inferior trunk of M2, mm from M1's end
_PCOM_SHARE = 0.6  # share of patients with a visible posterior communicating artery: an assumption
_SHARPEST_PER_MM = 0.4  # greatest curvature of the carotid's axis, 1/mm: its wall must not fold


def make_cerebral(draw: Draw) -> Drawn:
    """Return one side's anterior circulation and what was drawn for it; a stenosis lies in M1 or the carotid artery."""
    side = "left" if draw.generator.random() < 0.5 else "right"
    trunks = 3 if draw.generator.random() < TRIFURCATION_SHARE else 2
    siphon = branching.truncated(draw, SIPHON_MM, SIPHON_SD_MM, 21.0, 45.0)
    m1 = branching.truncated(draw, M1_MM, M1_SD_MM, 7.0, 38.0)
    return branching.until_it_fits("cerebral arteries", _draw, draw, side, trunks, siphon, m1)


def _draw(
    draw: Draw,
    side: str,
    trunks: int,
    siphon_mm: float,
    m1_mm: float,
) -> Drawn:
    points, marks = _main(draw, siphon_mm, m1_mm)
    radius, calibre = _radius(draw, points, marks)
    place = np.arange(len(points))
    section = np.select([place <= marks["terminus"], place <= marks["M2"]], ["ICA", "M1"], default="M2 inferior")
    a1_mm = branching.truncated(draw, A1_MM, 3.0, *A1_RANGE_MM)
    plans = varied(draw, _plans(draw, marks, a1_mm, calibre, trunks))
    plans, forks = _opened_trunks(draw, plans)
    points = bent(draw, points, radius, forks=forks)
    vessels = [branching.Vessel(points, radius, section.tolist())]
    vessels = branching.with_side_branches(draw, vessels, plans)
    narrow = []
    if draw.generator.random() < draw.stenosis_share:
        low, high = (
            (marks["cavernous"], marks["terminus"])
            if draw.generator.random() < 0.5
            else (marks["terminus"], marks["M2"])
        )
        low, high = low + 0.2 * (high - low), high - 0.2 * (high - low)
        shares = (low / len(points), high / len(points))
        narrow, vessels = branching.narrowed(draw, vessels, 0, shares)
    whole = {vessel.section[-1]: index for index, vessel in enumerate(vessels)}
    aca = vessels[whole["A1"]]
    beyond = length_along(aca.points) > a1_mm
    vessels[whole["A1"]] = replace(aca, section=np.where(beyond, "A2", "A1").tolist())
    if side == "right":
        vessels = [replace(vessel, points=vessel.points * np.array([-1.0, 1.0, 1.0])) for vessel in vessels]
    along = length_along(points)
    carotid = points[: marks["terminus"] + 1]
    drawn = {
        "side": side,
        "trunks": trunks,
        "siphon_length_mm": float(along[marks["terminus"]] - along[marks["cavernous"]]),
        "m1_length_mm": float(along[marks["M2"]] - along[marks["terminus"]]),
        "a1_length_mm": a1_mm,
        "carotid_tortuosity": shape.tortuosity(carotid),
        "carotid_curvature_mean_per_mm": float(shape.curvature(carotid).mean()),
        "stenoses": narrow,
    }
    return branching.build_tree(vessels, CEREBRAL_SECTIONS), drawn


def _main(draw: Draw, siphon_mm: float, m1_mm: float) -> tuple[Float[np.ndarray, "n 3"], dict[str, int]]:
    """Return carotid, M1 and the inferior trunk of M2 in one line, and where on it each begins."""
    before = _TO_SIPHON + draw.generator.normal(0, 0.8, _TO_SIPHON.shape)
    knees = _SIPHON + draw.generator.normal(0, 1.0, _SIPHON.shape) * np.array([0.5, 1.0, 1.0])
    lateral = np.array([0.96, float(draw.generator.normal(0, 0.15)), float(draw.generator.normal(0.15, 0.15))])
    lateral = lateral / np.linalg.norm(lateral)
    bow = float(draw.generator.normal(0.0, 0.08)) * m1_mm * np.array([0.0, 0.3, 1.0])
    m1 = m1_mm * np.array([0.4, 0.75, 1.0])[:, None] * lateral + np.array([0.8, 0.9, 0.0])[:, None] * bow
    m2 = m1[-1] + _BEYOND_M1 + draw.generator.normal(0, 1.0, _BEYOND_M1.shape)
    wiggle = shape.Wiggle.draw(draw.generator, 13.0, 45.0)
    amplitude, stretch = float(draw.generator.uniform(0.2, 0.6)), np.ones(2)
    points, marks = knees, dict[str, int]()
    for _ in range(4):
        # Siphon and M1 take their lengths from the draw; what lies before and behind keeps its own.
        siphon = knees[0] + (knees - knees[0]) * stretch[0]
        ends = siphon[-1] + np.concatenate([m1 * stretch[1], m2 + m1[-1] * (stretch[1] - 1.0)])
        points = _rounded(np.concatenate([before, siphon, ends]))
        points = wiggle.apply(points, shape.parallel_normals(shape.tangents(points)), amplitude, 12.0)
        points = _rounded(points[::4])
        names = {"cavernous": siphon[0], "ophthalmic": siphon[4], "terminus": siphon[-1], "M2": ends[2]}
        marks = {name: int(np.argmin(np.linalg.norm(points - at, axis=1))) for name, at in names.items()}
        along = length_along(points)
        found = along[[marks["terminus"], marks["M2"]]] - along[[marks["cavernous"], marks["terminus"]]]
        stretch = stretch * np.array([siphon_mm, m1_mm]) / np.maximum(found, 1.0)
    if shape.curvature(points).max() > _SHARPEST_PER_MM or marks["M2"] - marks["terminus"] < 8:
        raise branching.NoShape
    return points, marks


def _rounded(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "m 3"]:
    """Return the curve through the points with its knees rounded over 2 mm."""
    return shape.curve_through(gaussian_filter1d(shape.curve_through(points), 4.0, axis=0, mode="nearest")[::2])


def _radius(
    draw: Draw, points: Float[np.ndarray, "n 3"], marks: dict[str, int]
) -> tuple[Float[np.ndarray, "n"], float]:
    calibre = branching.truncated(draw, 1.0, 0.12, 0.72, 1.3)
    place = [0, marks["cavernous"], marks["terminus"], marks["terminus"] + 5, marks["M2"], marks["M2"] + 5, len(points)]
    wide = DIAMETER_MM
    diameter = [4.8, wide["cavernous"], wide["terminus"], wide["M1"], 2.8, wide["M2"], 1.5]
    own = np.interp(np.arange(len(points)), place, diameter)
    return 0.5 * calibre * own * branching.uneven(draw, length_along(points)), calibre


def _plans(
    draw: Draw,
    marks: dict[str, int],
    a1_mm: float,
    calibre: float,
    trunks: int,
) -> list[branching.SidePlan]:
    origins = {
        "A1": marks["terminus"],
        "M2 superior": marks["M2"],
        "M2 middle": marks["M2"],
        "ophthalmic": marks["ophthalmic"],
        "PCom": (marks["ophthalmic"] + marks["terminus"]) // 2,
    }
    lengths = {"A1": a1_mm + 55.0, "M2 superior": 42.0, "M2 middle": 36.0, "ophthalmic": 26.0, "PCom": 16.0}
    presence = factor(draw, draw.population.side_share)
    shares = {"M2 middle": float(trunks == 3), "PCom": _PCOM_SHARE * presence, "ophthalmic": 1.0}
    if presence < 1:
        shares["ophthalmic"] = presence
    plans = []
    for name, origin in origins.items():
        if draw.generator.random() >= shares.get(name, 1.0):
            continue
        courses = vessel_data("cerebral")["courses"][name]
        begins = [begin + a1_mm - A1_MM if name == "A1" and begin else begin for begin, _ in courses]
        own = DIAMETER_MM.get(name, DIAMETER_MM["M2"]) * calibre
        plans.append(
            branching.SidePlan(
                section=name,
                origin=origin,
                length_mm=lengths[name] * float(draw.generator.uniform(0.85, 1.15)),
                diameter_mm=own * branching.truncated(draw, 1.0, 0.1, 0.7, 1.3),
                courses=tuple((begin, course) for begin, (_, course) in zip(begins, courses, strict=True)),
                angle_deg=(38.0, 58.0) if name.startswith("M2") else (60.0, 90.0),
            )
        )
    return plans


def _opened_trunks(draw: Draw, plans: list[branching.SidePlan]) -> tuple[list[branching.SidePlan], list[Fork]]:
    """Return the plans and where the main line gives way; the inferior trunk of M2, which goes on from M1, and the
    superior one each take half of the population's angle."""
    forks = forks_of(plans, 0)
    if draw.population.trunks_angle_deg is None:
        return plans, forks
    mean, sd, low, high = draw.population.trunks_angle_deg
    half = 0.5 * branching.truncated(draw, mean, sd, low, high)
    at = next(place for place, plan in enumerate(plans) if plan.section == "M2 superior")
    plans = [*plans[:at], replace(plans[at], angle_deg=(half - 4.0, half + 4.0)), *plans[at + 1 :]]
    own = Fork(plans[at].origin, plans[at].courses[0][1], half)
    return plans, [fork for fork in forks if fork.index != own.index] + [own]
