"""An aorto-iliac path, drawn at random, and stiff wires that straighten it.

The compliant wall of the rod core stiffens over 4 mm, the width of a coronary artery. Pelvic arteries are wider, and
more tissue lies around them. The same physics holds at another scale: with lengths in units of λ mm, EI is divided by
λ², and the bed's stiffness, a force for each length and displacement, is multiplied by λ². So a path is simulated at
the scale at which its bed stiffens over 4 units. Forces are the same at every scale.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicSpline
from scipy.optimize import brentq
from scipy.spatial import KDTree

from endopilot.anatomy.distance import add_catheter, distance_map_from_spheres, sample
from endopilot.anatomy.tree import make_centerline
from endopilot.devices.device import Wire
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.rod import POISSON_RATIO
from endopilot.simulation.simulate import simulate
from endopilot.types import Anatomy, Branch, DistanceMap, Insertion, VesselTree

WIRES_GPA = {"Amplatz": 9.5, "Amplatz Extra Stiff": 29.2, "Amplatz Super Stiff": 60.3, "Lunderquist Extra Stiff": 158.4}
"""Flexural moduli of stiff wires of 0.035 inch, GPa, the section taken as full and round: Harrison 2011."""
WIRE_MM = 0.889
"""Diameter of these wires, mm: 0.035 inch."""
FLOPPY_MM, TAPER_MM, FLOPPY_N_MM2 = 40.0, 30.0, 8.0
"""Length of their floppy tip, of the taper behind it, mm, and EI of the tip, N·mm², assumed as that of the J wire."""
TORTUOSITY, TORTUOSITY_LIMITS = (1.36, 0.21), (1.05, 1.7)
"""Length of the common and external iliac artery over the distance of their ends: mean and SD of 110 patients with an
aneurysm (Ann Vasc Surg 2023, S0890-5096(23)00149-8), and the least and largest that are drawn."""
COMMON_MM = (40.0, 70.0)
"""Least and largest length of the common iliac artery, mm, assumed about the published means of 52.8 mm on the right
and 56.3 mm on the left (Yun and Park, Ann Surg Treat Res 88 (2015) 334-340)."""
EXTERNAL_MM = (90.0, 120.0)
"""Least and largest length of the external iliac artery, mm, assumed."""
COMMON_WIDTH_MM, EXTERNAL_WIDTH_MM, AORTA_WIDTH_MM = (9.0, 15.0), (7.0, 9.0), 20.0
"""Least and largest diameter of the common and of the external iliac artery, and the aorta's, mm. Published: 9 and
7.5 mm in healthy adults (CT of 112 patients, PAIRS 2022, e-poster 1643), 13.6 ± 1.5 mm for common iliac arteries in
which stent grafts end (PMC5624232), 20.1 ± 2.9 mm for the aorta (Surg Radiol Anat 35 (2013) 411-417)."""
APART_DEG = (35.0, 11.1)
"""Mean and SD of the angle between the common iliac arteries, degrees, of 70 people ("Distribution of the geometric
parameters of human aortic bifurcations", Arteriosclerosis 1986)."""
TISSUE_MPA = (0.0023, 0.012)
"""Least and largest modulus of the tissue around, MPa: three times the shear modulus of fat in living people, 752 Pa
(J Mech Behav Biomed Mater 2023), and that of the heart's muscle in docs/concepts/wall.md."""
STIFFENS_OVER_MM = (20.0, 40.0)
"""Least and largest width of the tissue that shears, mm, assumed: what may lie between the artery and the bone."""
FRICTION = (0.02, 0.1)
"""Least and largest Coulomb coefficient of a PTFE-coated wire on wet intima, assumed."""
PUSH_LIMIT_N = 10.0
"""Force at which the hand slips on the wire, N, assumed."""
_CORE_STIFFENS_OVER_MM = 4.0
_STEP_MM, _COARSE_MM, _ELEMENT_MM = 1.0, 5.0, 1.5
_SPACING = 0.25
"""Grid spacing of the distance map, in radii of the narrowest artery."""
_AORTA_MM, _BEYOND_MM = 220.0, 130.0
"""Length of the aorta, and of the wire in it, mm: the floppy tip lies beyond the iliac arteries."""
_HALF_WAVES, _TRIALS = 3, 300
_NARROWS_MM = 10.0
"""The arteries narrow over this length to either side of the iliac bifurcation, mm."""
_LEAVES_DEG, _LEAST_BEND_MM, _CLEAR_MM = 60.0, 15.0, 20.0
"""Largest angle at which the common iliac artery leaves the aorta's direction, degrees; least radius of a bend, mm;
least distance of parts that lie farther apart along the path than twice that, mm: assumed."""


@dataclass(frozen=True, eq=False)
class AortoIliac:
    """A path from the groin into the aorta, and the tissue around.

    Attributes:
        iliac_mm: points on the axis of the external and the common iliac artery, from the groin to the bifurcation, mm.
        radius_mm: radius of the arteries there, mm.
        aorta_mm: points on the aorta's axis, from the bifurcation on, mm.
        tissue_mpa: modulus of the tissue around, MPa.
        stiffens_over_mm: width of the tissue that shears, mm.
        friction: of the wire on the wall.
    """

    iliac_mm: Float[np.ndarray, "n 3"]
    radius_mm: Float[np.ndarray, "n"]
    aorta_mm: Float[np.ndarray, "m 3"]
    tissue_mpa: float
    stiffens_over_mm: float
    friction: float

    @property
    def scale(self) -> float:
        """Length of the unit in which the path is simulated, mm."""
        return self.stiffens_over_mm / _CORE_STIFFENS_OVER_MM

    def foundation_n_mm2(self, bend_n_mm2: float) -> float:
        """Return the stiffness of the bed for a wire of some EI (N·mm²), N/mm², by docs/concepts/wall.md."""
        width = 2 * float(self.radius_mm[-1])
        stiffening = (self.tissue_mpa * width**4 / bend_n_mm2) ** (1 / 12)
        return 0.65 * stiffening * self.tissue_mpa / (1 - 0.5**2)

    def anatomy(self) -> Anatomy:
        """Return it as a vessel in units of `scale`: the iliac arteries, then the aorta."""
        unit = 1 / self.scale
        wide = np.full(len(self.aorta_mm), AORTA_WIDTH_MM / 2)
        wide[0] = self.radius_mm[-1]
        lines = [
            (self.iliac_mm, self.radius_mm, -1),
            (self.aorta_mm, wide, 0),
        ]
        branches: list[Branch] = []
        for points, radius, parent in lines:
            begins = float(branches[0].centerline.abscissa[-1]) if parent >= 0 else 0.0
            line = make_centerline(unit * points, unit * radius, begins)
            branches.append(Branch(line, parent, np.zeros(len(points), dtype=np.int64)))
        tree = VesselTree(tuple(branches), ("aorto-iliac",))
        first = unit * self.iliac_mm[:2]
        insertion = Insertion(first[0], (first[1] - first[0]) / np.linalg.norm(first[1] - first[0]))
        inside = distance_map_from_spheres(tree, spacing_mm=_SPACING * unit * float(self.radius_mm.min()))
        sheath = float(unit * self.radius_mm[0])
        return Anatomy(
            name="aorto-iliac path",
            tree=tree,
            distance_map=add_catheter(inside, insertion, sheath),
            insertion=insertion,
            catheter_radius_mm=sheath,
        )


def draw_path(random: np.random.Generator) -> AortoIliac:
    """Draw a path and the tissue around it, as this module's constants say.

    The iliac arteries wind about the line between their ends in three half waves of random directions, as far as the
    drawn tortuosity asks. Paths that bend too sharply for their width, or come back to themselves, are drawn anew.
    """
    while True:
        tortuosity = random.normal(*TORTUOSITY)
        apart = np.deg2rad(random.normal(*APART_DEG))
        common, external = random.uniform(*COMMON_MM), random.uniform(*EXTERNAL_MM)
        if not TORTUOSITY_LIMITS[0] <= tortuosity <= TORTUOSITY_LIMITS[1]:
            continue
        for _ in range(_TRIALS):
            waves = random.normal(size=(_HALF_WAVES, 2)) / np.arange(1, _HALF_WAVES + 1)[:, None]
            axis = _hung(_wound(common + external, tortuosity, waves), apart / 2)
            if _is_open(axis):
                return _surrounded(axis, common, random)


def _surrounded(axis: Float[np.ndarray, "n 3"], common_mm: float, random: np.random.Generator) -> AortoIliac:
    """Draw the widths of the arteries along an axis that begins at the bifurcation, and the tissue around."""
    widths = random.uniform(*COMMON_WIDTH_MM), random.uniform(*EXTERNAL_WIDTH_MM)
    narrows = [common_mm - _NARROWS_MM, common_mm + _NARROWS_MM]
    radius = np.interp(_STEP_MM * np.arange(len(axis)), narrows, np.array(widths) / 2)
    return AortoIliac(
        iliac_mm=axis[::-1],
        radius_mm=radius[::-1],
        aorta_mm=np.outer(np.arange(0, _AORTA_MM, _STEP_MM), [0.0, 0.0, 1.0]),
        tissue_mpa=float(np.exp(random.uniform(*np.log(TISSUE_MPA)))),
        stiffens_over_mm=random.uniform(*STIFFENS_OVER_MM),
        friction=random.uniform(*FRICTION),
    )


def _wound(length_mm: float, tortuosity: float, waves: Float[np.ndarray, "waves 2"]) -> Float[np.ndarray, "n 3"]:
    """Return a line of some length that winds about the x axis, evenly spaced."""
    fine = np.linspace(0, 1, 2001)
    sines = np.sin(np.pi * np.outer(fine, np.arange(1, len(waves) + 1))) @ waves

    def line(amplitude: float) -> Float[np.ndarray, "n 3"]:
        return np.column_stack([fine, amplitude * sines])

    amplitude: Any = brentq(lambda size: tortuosity_index(line(size)) - tortuosity, 0.0, 10.0)
    points = line(amplitude)
    points *= length_mm / np.linalg.norm(np.diff(points, axis=0), axis=1).sum()
    return _evenly(points, _STEP_MM)


def _hung(axis: Float[np.ndarray, "n 3"], angle_rad: float) -> Float[np.ndarray, "n 3"]:
    """Return a line about the x axis such that it winds about a line in the xz plane, at an angle to -z."""
    down, across = np.array([np.sin(angle_rad), 0.0, -np.cos(angle_rad)]), np.array([0.0, 1.0, 0.0])
    return axis @ np.stack([down, across, np.cross(down, across)])


def _is_open(axis: Float[np.ndarray, "n 3"]) -> bool:
    """Return whether a path from the bifurcation on leaves the aorta, bends gently enough and stays off itself."""
    first = np.gradient(axis, _STEP_MM, axis=0)
    second = np.gradient(first, _STEP_MM, axis=0)
    curvature = np.linalg.norm(np.cross(first, second), axis=1) / np.linalg.norm(first, axis=1) ** 3
    if -first[0, 2] < np.cos(np.deg2rad(_LEAVES_DEG)) or curvature.max() > 1 / _LEAST_BEND_MM:
        return False
    aorta = np.outer(np.arange(_AORTA_MM, 0, -_COARSE_MM), [0.0, 0.0, 1.0])
    points = np.concatenate([aorta, _evenly(axis, _COARSE_MM)])
    apart = np.linalg.norm(points[:, None] - points[None], axis=-1)
    along = _COARSE_MM * np.abs(np.subtract.outer(np.arange(len(points)), np.arange(len(points))))
    return bool((apart[along > 2 * _CLEAR_MM] > _CLEAR_MM).all())


def tortuosity_index(axis: Float[np.ndarray, "n 3"]) -> float:
    """Return a line's length over the distance of its ends."""
    return float(np.linalg.norm(np.diff(axis, axis=0), axis=1).sum() / np.linalg.norm(axis[-1] - axis[0]))


def stiff_wire(modulus_gpa: float, *, friction: float) -> Wire:
    """Return a wire of 0.035 inch and some flexural modulus (GPa) behind its floppy tip, EI = E π d⁴/64."""
    shaft = 1000 * modulus_gpa * math.pi * WIRE_MM**4 / 64
    bend = (FLOPPY_N_MM2, FLOPPY_N_MM2, shaft)
    return Wire(
        name=f"{modulus_gpa:g} GPa",
        diameter_mm=WIRE_MM,
        abscissa_mm=(0.0, FLOPPY_MM, FLOPPY_MM + TAPER_MM),
        bend_stiffness_n_mm2=bend,
        twist_stiffness_n_mm2=tuple(each / (1 + POISSON_RATIO) for each in bend),
        tip_bend_rad=0.0,
        tip_bend_length_mm=0.0,
        tip_load_n=None,
        friction=friction,
        max_velocity_mm_s=60.0,
        max_rotation_rad_s=10.0,
        push_limit_n=PUSH_LIMIT_N,
        pull_limit_n=PUSH_LIMIT_N,
        torque_limit_n_mm=100.0,
        sources={},
    )


def scaled(device: Wire, unit_mm: float) -> Wire:
    """Return a device with lengths in units of some mm; forces stay in N."""
    return replace(
        device,
        diameter_mm=device.diameter_mm / unit_mm,
        abscissa_mm=tuple(each / unit_mm for each in device.abscissa_mm),
        bend_stiffness_n_mm2=tuple(each / unit_mm**2 for each in device.bend_stiffness_n_mm2),
        twist_stiffness_n_mm2=tuple(each / unit_mm**2 for each in device.twist_stiffness_n_mm2),
        torque_limit_n_mm=device.torque_limit_n_mm / unit_mm,
    )


@dataclass(frozen=True, eq=False)
class Straightened:
    """What a wire does to a path.

    Attributes:
        moved_mm: by how much the axis of the iliac arteries is displaced beside points of the wire, from the
            bifurcation on, mm.
        axis_mm: where it lies then, mm.
        begun_mm: where it lay before, from the groin on, mm. The aorta's radius next to the bifurcation, where the
            arteries share one lumen, is left out of all three.
        force_n: sum of the wall's forces, N.
        through: whether the wire came as far as commanded; not where the hand slipped.
        valid: whether the simulation converged and the wire stayed within the tissue.
    """

    moved_mm: Float[np.ndarray, "n"]
    axis_mm: Float[np.ndarray, "n 3"]
    begun_mm: Float[np.ndarray, "m 3"]
    force_n: float
    through: bool
    valid: bool

    @property
    def largest_mm(self) -> float:
        """Largest displacement of the axis, mm."""
        return float(self.moved_mm.max())

    @property
    def mean_mm(self) -> float:
        """Mean displacement of the axis over the iliac arteries, mm."""
        return float(self.moved_mm.mean())

    @property
    def tortuosity(self) -> float:
        """Length of the displaced axis over the distance of its ends."""
        return tortuosity_index(self.axis_mm)

    @property
    def tortuosity_before(self) -> float:
        """The same before the wire came."""
        return tortuosity_index(self.begun_mm)


def straighten(
    path: AortoIliac, anatomy: Anatomy, wire: Wire, *, rigid: bool = False, config: SimulatorConfig | None = None
) -> Straightened:
    """Push a wire from the groin into the aorta and let it rest for a second.

    Args:
        path: the path and the tissue around.
        anatomy: the same as `AortoIliac.anatomy` returns it.
        wire: in mm.
        rigid: leave out that the wall yields.
        config: settings of the rod core, in units of the path's scale; elements of 1.5 mm if not given.
    """
    unit = path.scale
    config = config or SimulatorConfig(element_mm=_ELEMENT_MM / unit)
    if not rigid:
        bed = path.foundation_n_mm2(wire.bend_stiffness_n_mm2[-1]) * unit**2
        config = replace(config, compliant_wall_n_mm2=bed)
    device = scaled(wire, unit)
    iliac = anatomy.tree.branches[0].centerline
    inserted = float(iliac.abscissa[-1]) + _BEYOND_MM / unit
    rollout = simulate(
        anatomy, device, np.zeros((1, 2, 2)), initial=np.array([[inserted, 0.0]]), config=config, record_shape=True
    )
    assert rollout.shape is not None
    valid = bool(rollout.valid.all())
    axis = iliac.points[iliac.abscissa < iliac.abscissa[-1] - AORTA_WIDTH_MM / 2 / unit]
    shape = rollout.shape[0, -1] if valid else axis[::-1]
    moved, displaced = displaced_axis(anatomy.distance_map, axis, shape, device.tip_radius_mm)
    return Straightened(
        moved_mm=unit * moved,
        axis_mm=unit * displaced,
        begun_mm=unit * axis,
        force_n=float(rollout.contact_force_sum[0, -1]),
        through=bool(valid and abs(rollout.inserted_length[0, -1, 0] - inserted) < 1e-6),
        valid=valid,
    )


def displaced_axis(
    distance_map: DistanceMap,
    axis: Float[np.ndarray, "n 3"],
    wire: Float[np.ndarray, "m 3"],
    radius_mm: float,
) -> tuple[Float[np.ndarray, "k"], Float[np.ndarray, "k 3"]]:
    """Return how far a wire displaces a vessel's axis beside points of the wire, and where the axis lies then.

    Where the wire lies outside the wall it has displaced the vessel by as much as that, away from the nearest point of
    the axis.

    Args:
        distance_map: of the vessel.
        axis: points on its axis.
        wire: nodes from its tip on.
        radius_mm: of the wire.
    """
    step = 0.1 * distance_map.spacing_mm
    beside, near = _evenly(wire, step), _evenly(axis, 0.1 * step)
    nearest = np.asarray(KDTree(near).query(beside)[1])
    within = (nearest > 0) & (nearest < len(near) - 1)
    beside, near = beside[within], near[nearest[within]]
    aside = (beside - near) / np.maximum(np.linalg.norm(beside - near, axis=1, keepdims=True), 1e-12)
    moved = np.maximum(radius_mm - sample(distance_map, beside, order=2), 0.0)
    return moved, near + moved[:, None] * aside


def _evenly(line: Float[np.ndarray, "n 3"], step: float) -> Float[np.ndarray, "m 3"]:
    """Return evenly spaced points on a smooth curve through those of a line: a wire's elements are long chords."""
    along = np.append(0, np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1)))
    return CubicSpline(along, line)(np.arange(0, along[-1], step))
