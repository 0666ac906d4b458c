"""A bolus of contrast, carried along a vessel tree by the blood, `Flow`, and the tree's fine branches, `grow`.

Blood flows in at the ostium. At a fork the branches share it by the cubes of their radii (Murray, PNAS 12, 1926), and
within a branch it is the same everywhere, so that blood is fast where the vessel is narrow. Along the stream the blood
passes one well-mixed volume after another, each in the same time ("tanks in series"; Levenspiel, Chemical Reaction
Engineering). So the contrast at a place depends on the time alone that blood takes to get there: the course at the
ostium, delayed and dispersed, with a variance of the transit time times that of one volume. All contrast that flows in
is in the tree, or has flowed out of its ends.

A CT does not show fine side branches. Where a vessel tapers, blood leaves it: by the same law, the cube that a vessel
loses along itself is that of side branches. These run over the heart, or dive into its muscle (septal branches), taper
as a main artery does, and branch by the same law until they are too thin to be seen.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.signal import lfilter
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from endopilot.types import Anatomy, VesselTree
from endopilot.xray.absorbers import across
from endopilot.xray.carm import Places, Vector

MIXING_S = 0.03
"""Time in which blood passes one well-mixed volume, s: an assumption. After one second of transit a sharp front is then
spread by √(1 s · 0.03 s) = 0.17 s, standard deviation."""
_STEPS = 24
"""Steps of the balance of contrast in `MIXING_S`."""
_REFLUX_S = 0.3
"""Time after which the aorta has washed away what flows back into it, s: an assumption."""
_INLET_MM = 10.0
"""The blood's velocity at the ostium is that of the mean section of this length of vessel, mm."""


@dataclass(frozen=True)
class Injection:
    """Contrast that is injected through the guiding catheter, at a rate that rises and falls within `ramp_s`; what the
    vessel does not take flows back into the aorta."""

    start_s: float
    duration_s: float
    rate_ml_s: float
    ramp_s: float = 0.2

    def rate(self, times_s: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
        """Return the rate at some times, ml/s."""
        end = self.start_s + self.duration_s
        up, down = (times_s - self.start_s) / self.ramp_s, (end - times_s) / self.ramp_s
        return self.rate_ml_s * np.clip(np.minimum(up, down), 0.0, 1.0)


class Flow:
    """The blood's steady flow through a vessel tree.

    Attributes:
        points: of all centerlines, branch after branch, LPS mm.
        radius: of the vessel at each, mm.
        branch: that each belongs to.
        section: of the tree's `section_names`, of each.
        transit_s: time from the ostium to each, s.
        inflow_ml_s: blood that flows in at the ostium, ml/s.
    """

    def __init__(self, tree: VesselTree, velocity_mm_s: float) -> None:
        """Share the blood among the branches; its velocity is that behind the ostium, mean over the section, mm/s."""
        lines = [branch.centerline for branch in tree.branches]
        first = lines[0]
        near = first.abscissa <= first.abscissa[0] + _INLET_MM
        self.inflow_ml_s = float(velocity_mm_s * np.pi * np.mean(first.radius[near] ** 2) / 1000)
        inflow, arrival = np.zeros(len(lines)), np.zeros(len(lines))
        inflow[0] = self.inflow_ml_s
        transits = []
        for index, line in enumerate(lines):
            area = np.pi * line.radius**2
            slices = 0.5 * (area[1:] + area[:-1]) * np.diff(line.abscissa) / 1000
            transits.append(arrival[index] + np.append(0.0, np.cumsum(slices)) / inflow[index])
            children = tree.children(index)
            calibre = np.array([np.median(lines[child].radius) ** 3 for child in children])
            for child, share in zip(children, calibre / calibre.sum() if len(children) else (), strict=True):
                inflow[child], arrival[child] = inflow[index] * share, transits[-1][-1]
        sizes = [len(line.points) for line in lines]
        self.points = np.concatenate([line.points for line in lines])
        self.radius = np.concatenate([line.radius for line in lines])
        self.branch = np.repeat(np.arange(len(lines)), sizes)
        self.section = np.concatenate([branch.section for branch in tree.branches])
        self.rate_ml_s, self.transit_s = inflow[self.branch], np.concatenate(transits)

    def append(self, points: Places, radius: Float[np.ndarray, "n"], parent: int) -> None:
        """Append a branch that leaves at a point, in which blood is as fast as at its begin by Murray's law."""
        rate = self.rate_ml_s[parent] * (radius[0] / self.radius[parent]) ** 3
        steps = np.linalg.norm(np.diff(points, axis=0, prepend=self.points[parent : parent + 1]), axis=1)
        transit_s = self.transit_s[parent] + np.cumsum(steps) * np.pi * radius[0] ** 2 / (1000 * rate)
        self.points, self.radius = np.concatenate([self.points, points]), np.append(self.radius, radius)
        self.transit_s = np.append(self.transit_s, transit_s)
        self.rate_ml_s = np.append(self.rate_ml_s, np.full(len(points), rate))
        self.branch = np.append(self.branch, np.full(len(points), self.branch[-1] + 1))
        self.section = np.append(self.section, np.full(len(points), self.section[parent]))

    def contrast(
        self, injection: Injection, times_s: Float[np.ndarray, "frames"]
    ) -> tuple[Float[np.ndarray, "tanks"], Float[np.ndarray, "frames tanks"]]:
        """Return transit times, s, and the share of contrast in the blood there at some times from 0 on."""
        step = MIXING_S / _STEPS
        tanks = int(np.ceil(min(float(self.transit_s.max()), float(times_s[-1])) / MIXING_S)) + 2
        every = (np.arange(int(times_s[-1] / step) + 2) + 0.5) * step
        share = [np.minimum(injection.rate(every) / self.inflow_ml_s, 1)]  # at the ostium, then in each volume
        for _ in range(tanks):
            share.append(np.asarray(lfilter([0.0, 1 / _STEPS], [1.0, 1 / _STEPS - 1], share[-1])))
        shares = np.stack(share, axis=1)[np.rint(times_s / step).astype(int)]
        return np.append(0.0, (np.arange(tanks) + 0.5) * MIXING_S), shares

    def reflux_ml(self, injection: Injection, times_s: Float[np.ndarray, "frames"]) -> Float[np.ndarray, "frames"]:
        """Return the contrast around the ostium that the vessel does not take, at some times from 0 on, ml."""
        step = MIXING_S / _STEPS
        every = np.arange(int(times_s[-1] / step) + 2) * step
        excess = np.maximum(injection.rate(every) - self.inflow_ml_s, 0) * step
        return lfilter([1.0], [1.0, -np.exp(-step / _REFLUX_S)], excess)[np.rint(times_s / step).astype(int)]

    def transit_of(self, places: Places) -> Float[np.ndarray, "n"]:
        """Return the time, s, that blood takes from the ostium to the centerline nearest to each place, LPS mm."""
        return self.transit_s[KDTree(self.points).query(places)[1]]


_STEP_MM, _SPOKES = 0.4, 6
_THINNEST_MM, _FADES = 0.35, 20
"""Radius at which a branch ends, mm: what is thinner hardly rises above the noise. It fades in the last steps."""
_LENGTH = 75.0
"""Length of a vessel over its radius: an anterior descending artery's 1.85 mm taper over some 140 mm (Dodge 1992)."""
_APART_MM, _SHARES, _DIVES = 7.0, (0.2, 0.5), 0.3
"""Mean distance of side branches, mm: eight to ten septal branches along some 70 mm. Range of their radius as a share
of the vessel's, and share of those that dive: assumptions."""
_ANGLE_RAD, _ANGLE_SD = 0.9, 0.3
"""Mean and standard deviation of the angle at which they leave, rad: 52° [22–97] in fourteen real right arteries."""
_CURVATURE, _BENDS_MM = 0.08, 4.0
"""Curvature of what runs over the heart, standard deviation, 1/mm, and the length after which it is another: the
curvature's 95th percentile is 0.12–0.17 /mm in thirty real trees."""


def grow(anatomy: Anatomy, flow: Flow, random: np.random.Generator) -> tuple[Places, Float[np.ndarray, "n"]]:
    """Append fine branches to the flow's lines, and return them as small volumes: places, LPS mm, and sizes, mm³, six
    for each point that was appended."""
    tree = anatomy.tree
    centre, places, sizes = tree.line.points.mean(axis=0), [np.zeros((0, 3))], [np.zeros(0)]
    leaves, lines = tree.leaves(), [np.flatnonzero(flow.branch == k) for k in range(len(tree.branches))]
    for number, line in enumerate(lines):  # those that grow are appended, and grow too
        points, radius = flow.points[line], flow.radius[line]
        buds = _sides(points, radius, centre, random)
        if number in leaves:
            buds.append((len(line) - 1, points[-1] - points[-3], float(radius[-1]), False))
        for place, heading, wide, dives in buds:
            heading = heading / np.linalg.norm(heading)
            run = _run(
                points[place] + radius[place] * heading, heading, wide, dives, centre, random
            )  # from the wall on
            thin = np.linspace(wide, min(wide, _THINNEST_MM), len(run))
            lines.append(len(flow.points) + np.arange(len(run)))
            flow.append(run, thin, int(line[place]))
            first, second = across(np.gradient(run, axis=0))
            turn = 2 * np.pi * np.arange(_SPOKES) / _SPOKES
            ring = np.cos(turn)[:, None] * first[:, None] + np.sin(turn)[:, None] * second[:, None]
            places.append((run[:, None] + thin[:, None, None] / np.sqrt(2) * ring).reshape(-1, 3))
            fading = np.minimum(np.arange(len(run), 0, -1) / _FADES, 1)
            sizes.append(np.repeat(fading * np.pi * thin**2 * _STEP_MM / _SPOKES, _SPOKES))
    return np.concatenate(places), np.concatenate(sizes)


def _sides(
    points: Places, radius: Float[np.ndarray, "n"], centre: Vector, random: np.random.Generator
) -> list[tuple[int, Vector, float, bool]]:
    """Return the side branches of a line: where each leaves, its heading, its radius, mm, and if it dives."""
    found, whole, last = [], radius[0] ** 3, 0.0
    widest = np.maximum.accumulate(radius[::-1])[::-1]  # of what follows: a stenosis takes no blood away
    along = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1)))
    share, apart = random.uniform(*_SHARES), random.exponential(_APART_MM)
    for place in range(1, len(points) - 1):
        side = float(min(share * widest[place], max(whole - widest[place] ** 3, 0.0) ** (1 / 3)))
        if side < _THINNEST_MM or along[place] - last < apart:
            continue
        whole, last = whole - side**3, along[place]
        share, apart, dives = random.uniform(*_SHARES), random.exponential(_APART_MM), random.random() < _DIVES
        heading, outward = points[place + 1] - points[place - 1], points[place] - centre
        angle = random.normal(_ANGLE_RAD, _ANGLE_SD)
        axis = np.cross(outward, heading) if dives else random.choice((-1, 1)) * outward
        turned = Rotation.from_rotvec(angle * axis / np.linalg.norm(axis)).apply(heading)
        found.append((place, turned, side, bool(dives)))
    return found


def _run(
    place: Vector, heading: Vector, radius: float, dives: bool, centre: Vector, random: np.random.Generator
) -> Places:
    """Return the places of a branch, at equal distances."""
    places, kept = [], np.exp(-_STEP_MM / _BENDS_MM)
    shocks = random.normal(
        0, _CURVATURE * np.sqrt(1 - kept**2), _FADES + int(_LENGTH * max(radius - _THINNEST_MM, 0) / _STEP_MM)
    )
    bend, height = 0.0, np.linalg.norm(place - centre)
    for shock in shocks:
        place, bend = place + _STEP_MM * heading, kept * bend + shock
        outward = place - centre
        away = np.sqrt(outward @ outward)
        outward = outward / away
        if not dives:  # the heart is round about the tree's middle, near enough over a branch's length
            heading = heading - 0.1 * (heading @ outward + 0.1 * (away - height)) * outward
        (a, b, c), (x, y, z) = outward.tolist(), heading.tolist()  # numpy's cross takes half of a cine's time
        heading = heading + bend * _STEP_MM * np.array([b * z - c * y, c * x - a * z, a * y - b * x])
        heading = heading / np.sqrt(heading @ heading)
        places.append(place)
    return np.array(places)
