"""The atlas: synthetic patients whose vessels are drawn from published statistics."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Annotated

import numpy as np
from pydantic import model_validator

from endopilot.anatomy import distance
from endopilot.anatomy.distance import CATHETER_RADIUS_MM
from endopilot.atlas.arch import make_arch
from endopilot.atlas.cerebral import make_cerebral
from endopilot.atlas.lca import make_lca
from endopilot.atlas.population import Draw, Drawn, PopulationName, population_of
from endopilot.atlas.portal import make_portal
from endopilot.atlas.rca import make_rca
from endopilot.atlas.variation import catheter_direction, flattened
from endopilot.settings import Seed, Share, Within, settings
from endopilot.types import Anatomy, Insertion

CATHETER_LENGTH_MM = 30.0  # length of catheter behind the ostium that the distance map holds, mm

_KINDS: dict[str, Callable[[Draw], Drawn]] = {
    "rca": make_rca,
    "lca": make_lca,
    "cerebral": make_cerebral,
    "portal": make_portal,
    "arch": make_arch,
}

VESSELS = tuple(_KINDS)  # names of the kinds of vessel trees


@settings
class AtlasConfig:
    """Which synthetic patients to make."""

    vessel: str = "rca"
    """Kind of vessel tree: rca or lca (right or left coronary artery), cerebral (internal carotid with middle and
    anterior cerebral arteries), arch (aortic arch with its branches), portal (portal vein)."""
    count: Annotated[int, Within(1, 100000)] = 1
    """Number of patients."""
    seed: Seed = 0
    """Seed of the atlas: patient i is the same whatever the count."""
    stenosis_share: Share = 0.3
    """Share of the patients that have a stenosis, 0 to 1."""
    population: PopulationName = "patients"
    """How patients vary: patients (as measured in real ones: sharp bends, forks of any angle, missing branches, lumens
    that are not round) or textbook (published mean courses with smooth wiggles)."""

    @model_validator(mode="after")
    def _consistent(self) -> AtlasConfig:
        if self.vessel not in _KINDS:
            raise ValueError(f"vessel: {self.vessel!r}; choose from {', '.join(sorted(_KINDS))}")
        return self


def make_atlas(*, config: AtlasConfig | None = None) -> Iterator[Anatomy]:
    """Yield the patients of an atlas, one after another."""
    config = config or AtlasConfig()
    for index in range(config.count):
        yield make_patient(config, index)


def make_patient(config: AtlasConfig, index: int) -> Anatomy:
    """Return patient `index`, made from its exact centerline and radii; `provenance` holds what was drawn. The random
    stream is keyed by (seed, index), so that a patient does not depend on the others."""
    tree, drawn = make_patient_tree(config, index)
    draw = _draw(config, index, 1)
    name, source = f"{config.vessel}-{config.seed}-{index:04d}", {"source": "atlas", "vessel": config.vessel}
    source |= {"population": config.population, "seed": config.seed, "index": index}
    direction, catheter = catheter_direction(draw, tree, CATHETER_RADIUS_MM, CATHETER_LENGTH_MM)
    lumen = distance.distance_map_from_spheres(tree, beside=flattened(draw, tree))
    insertion = Insertion(position=tree.branches[0].centerline.points[0], direction=direction)
    return Anatomy(
        name=name,
        tree=tree,
        distance_map=distance.add_catheter(lumen, insertion, CATHETER_RADIUS_MM, CATHETER_LENGTH_MM),
        insertion=insertion,
        catheter_radius_mm=CATHETER_RADIUS_MM,
        provenance=source | drawn | catheter,
    )


def make_patient_tree(config: AtlasConfig, index: int) -> Drawn:
    """Return the centerline tree of patient `index`, and what was drawn for it, without a distance map."""
    return _KINDS[config.vessel](_draw(config, index, 0))


def _draw(config: AtlasConfig, index: int, purpose: int) -> Draw:
    """Return what a patient is drawn with, its random stream that for the tree (0), or for section and catheter (1)."""
    key = np.array([config.seed, index], dtype=np.uint64)
    stream = np.random.Philox(key=key, counter=np.array([0, 0, 0, purpose], dtype=np.uint64))
    population = population_of(config.vessel, config.population)
    return Draw(np.random.Generator(stream), config.stenosis_share, population)
