"""How the patients of an atlas differ from each other: the textbook's mean courses, or those and what patients show.

`textbook` patients follow published mean courses with smooth wiggles. `patients` have, on top of these, what was
measured on 19 patients' coronary CT angiograms (docs/evidence/atlas.md) and what is published for the other vessels:
sharp bends up to the tightest a lumen can make (curvature times radius 1), parents that give way at forks, side
branches of any angle and calibre, missing branches, lumens that are not round, and catheters that meet the vessel at an
angle.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal

import numpy as np

from endopilot.files import read_yaml
from endopilot.types import VesselTree

PopulationName = Literal["patients", "textbook"]

Spread = tuple[float, float, float, float]  # median, SD of the logarithm, bounds of a log-normal distribution

Courses = tuple[tuple[float, tuple[float, float, float]], ...]
"""Where a side branch heads: (abscissa from which it holds, mm; LPS direction), in order."""


@dataclass(frozen=True, kw_only=True)
class Population:
    """How one kind of vessel tree varies. The defaults add nothing to the textbook's courses, and draw nothing.

    Attributes:
        waves_deg: range of the amplitude by which the main vessels' direction varies, degrees.
        waves_mm: shortest and longest wavelength of these variations, mm.
        bends_per_100_mm: mean number of sharp bends in 100 mm of a main vessel; a patient's own number is drawn from
            an exponential distribution, so that a few patients have many, up to 2.5 times the mean.
        bend_deg: range of the angle to which a sharp bend turns the vessel to either side, degrees.
        bend_tightness: range of curvature times lumen radius in a sharp bend.
        deflection_deg: angle by which a main vessel gives way where a branch leaves, degrees.
        side_angle_deg: mean, SD, smallest and largest angle at which side branches leave, degrees; none for the
            ranges of their kinds.
        side_calibre: range of the factor on side branches' diameters.
        side_share: range of a patient's factor on the probability that each side branch is there.
        carina_mm: beyond a fork, lumens may stay in contact over this length, mm, and twice their radii.
        flattening: range of what a lumen's section is longer than wide, as a share of its width.
        ectasia_share: share of patients with a widening of a main vessel.
        tandem_share: share of the patients with a stenosis that have a second one in the same vessel.
        catheter_deg: angle between the catheter and the vessel 10 mm beyond the ostium, degrees; none for a catheter
            that lies along the vessel's first direction.
        left_main_flare: range of the factor by which the left main artery widens at its fork.
        left_main_mm: length of the left main artery, mm; none for the textbook's.
        left_main_turns_deg: angles by which LAD and circumflex turn away from the left main artery, degrees; none for
            those of the mean courses.
        trunks_angle_deg: mean, SD, smallest and largest angle between the two trunks of M2, degrees; none for the
            ranges of their kind.
    """

    waves_deg: tuple[float, float] = (0.0, 0.0)
    waves_mm: tuple[float, float] = (9.0, 30.0)
    bends_per_100_mm: float = 0.0
    bend_deg: tuple[float, float] = (25.0, 75.0)
    bend_tightness: tuple[float, float] = (0.35, 1.0)
    deflection_deg: Spread | None = None
    side_angle_deg: Spread | None = None
    side_calibre: tuple[float, float] = (1.0, 1.0)
    side_share: tuple[float, float] = (1.0, 1.0)
    carina_mm: float = 4.0
    flattening: tuple[float, float] = (0.0, 0.0)
    ectasia_share: float = 0.0
    tandem_share: float = 0.0
    catheter_deg: Spread | None = None
    left_main_flare: tuple[float, float] = (1.0, 1.0)
    left_main_mm: Spread | None = None
    left_main_turns_deg: tuple[Spread, Spread] | None = None
    trunks_angle_deg: Spread | None = None

    @property
    def bends_vessels(self) -> bool:
        """Whether main vessels are bent at all beyond the textbook's courses."""
        return self.waves_deg[1] > 0


@dataclass(frozen=True, eq=False)
class Draw:
    """What one patient is drawn with: a random stream, the share of patients with a stenosis, and how patients vary."""

    generator: np.random.Generator
    stenosis_share: float
    population: Population


Drawn = tuple[VesselTree, dict[str, Any]]  # a tree, and what was drawn for it


@dataclass(frozen=True, kw_only=True)
class SideKind:
    """How a side branch leaves: means and SDs of its origin and length, mm, and the share of patients that have it."""

    origin_mm: tuple[float, float]
    length_mm: tuple[float, float]
    diameter_mm: float
    share: float
    courses: Courses


def population_of(vessel: str, name: PopulationName) -> Population:
    """Return how a kind of vessel tree varies in a population."""
    return Population(**vessel_data(vessel)["patients"]) if name == "patients" else Population()


@cache
def side_kinds(vessel: str, of: str) -> dict[str, SideKind]:
    """Return the kinds of side branches of a vessel, by the names of their sections."""
    return {section: SideKind(**values) for section, values in vessel_data(vessel)[of].items()}


@cache
def vessel_data(vessel: str) -> dict[str, Any]:
    """Return what `vessels.yaml` holds of a kind of vessel tree."""
    return frozen(read_yaml(Path(__file__).parent / "vessels.yaml")[vessel])


def frozen(value: Any) -> Any:
    """Return what a YAML file holds, its lists as tuples."""
    if isinstance(value, dict):
        return {name: frozen(each) for name, each in value.items()}
    return tuple(map(frozen, value)) if isinstance(value, list) else value
