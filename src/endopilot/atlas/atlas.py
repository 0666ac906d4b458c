"""The atlas: synthetic patients whose vessels are drawn from published statistics."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Annotated, Any, cast

import numpy as np
from jaxtyping import Float
from pydantic import model_validator

from endopilot.anatomy import distance
from endopilot.anatomy.distance import CATHETER_RADIUS_MM, sample
from endopilot.anatomy.extract import AnatomyConfig, extract_anatomy
from endopilot.anatomy.labels import Scheme, label_tree
from endopilot.atlas.arch import make_arch
from endopilot.atlas.cerebral import make_cerebral
from endopilot.atlas.curves import tangents
from endopilot.atlas.lca import make_lca
from endopilot.atlas.population import Population, PopulationName, population_of
from endopilot.atlas.portal import make_portal
from endopilot.atlas.rca import make_rca
from endopilot.atlas.variation import catheter_direction, flattened
from endopilot.errors import InputError
from endopilot.settings import Seed, Share, Within, settings
from endopilot.types import Anatomy, Branch, Centerline, DistanceMap, Insertion, LumenMask, VesselTree, Volume

IN_PLANE_MM, SLICE_MM = (0.6, 0.75), (0.5, 0.5)  # ranges of the voxels' edges, mm
TAKEN_IN = (0.4, 0.8)  # voxels count as lumen up to this share of their edge outside of the wall
NARROWEST_MM = (0.6, 0.9)  # a vessel ends in the mask where it stays narrower than this radius, mm
_SCANS = 4
_MARGIN_MM = 3.0


def visible(generator: np.random.Generator, tree: VesselTree) -> VesselTree:
    """Return what of a tree is wide enough to be drawn: the first branch whole, each other up to its last point that
    is, or whole if what leaves its end is."""
    narrowest = float(generator.uniform(*NARROWEST_MM))
    ends = [int(np.flatnonzero(np.r_[True, b.centerline.radius >= narrowest])[-1]) for b in tree.branches]
    for index in reversed(range(len(tree.branches))):
        own, ahead = tree.branches[index], tree.branches[index].parent
        # A stub within its parent's lumen is no branch.
        if ahead >= 0 and _length_mm(own, ends[index]) > 2.0 * float(own.centerline.radius[0]):
            ends[ahead] = len(tree.branches[ahead].centerline.radius)
    kept, numbers = list[Branch](), {-1: -1}
    for index, branch in enumerate(tree.branches):
        whole = ends[index] == len(branch.centerline.radius) or index == 0
        reaches = whole or _length_mm(branch, ends[index]) > 2.0 * float(branch.centerline.radius[0])
        if branch.parent in numbers and reaches:
            numbers[index] = len(kept)
            kept.append(_cut(branch, len(branch.section) if whole else ends[index], numbers[branch.parent]))
    return VesselTree(tuple(kept), tree.section_names)


def _length_mm(branch: Branch, count: int) -> float:
    along = branch.centerline.abscissa
    return float(along[max(count - 1, 0)] - along[0])


def _cut(branch: Branch, count: int, parent: int) -> Branch:
    line = branch.centerline
    parts = (values[:count] for values in (line.points, line.radius, line.abscissa, line.normals))
    return Branch(Centerline(*parts), parent, branch.section[:count])


def seen_through_ct(
    generator: np.random.Generator,
    vessel: str,
    tree: VesselTree,
    lumen: DistanceMap,
    direction: Float[np.ndarray, "3"],
    name: str,
    catheter_radius_mm: float,
) -> tuple[Anatomy, dict[str, Any]]:
    """Return the anatomy that `endopilot anatomy` makes of a mask of the patient's lumen, and what was drawn for it.

    Masks have rough walls, end early, and are wide at their ends: those of seven real patients, with voxels of 0.6 to
    0.75 mm and slices of 0.5 mm, end at radii of 1.2 to 1.9 mm, median 1.4. `lumen` is the distance to the wall,
    without a catheter. Raises InputError where no vessel was found in four masks.
    """
    scheme = vessel if vessel in ("rca", "lca") else "generic"
    config = AnatomyConfig(vessel=scheme, catheter_radius_mm=catheter_radius_mm)  # pyright: ignore[reportArgumentType]
    ostium = Insertion(position=tree.branches[0].centerline.points[0], direction=direction)
    why = ""
    for rejected in range(_SCANS):
        voxel = np.array([*[float(generator.uniform(*IN_PLANE_MM))] * 2, float(generator.uniform(*SLICE_MM))])
        taken_in = float(generator.uniform(*TAKEN_IN))
        volume = rasterised(lumen, voxel, taken_in, generator.uniform(0.0, 1.0, 3))
        try:
            found = extract_anatomy(LumenMask(volume, ostium), name=name, config=config)
        except InputError as error:
            why = str(error)
            continue
        if scheme == "generic":
            found = Anatomy(
                name=found.name,
                tree=label_tree(found.tree, cast(Scheme, vessel)),
                distance_map=found.distance_map,
                insertion=found.insertion,
                catheter_radius_mm=found.catheter_radius_mm,
            )
        return found, {"voxel_mm": voxel.tolist(), "taken_in": taken_in, "scans_rejected": rejected}
    raise InputError(f"{name}: no vessel found in {_SCANS} masks of it ({why}); choose another seed")


def rasterised(
    lumen: DistanceMap, voxel_mm: Float[np.ndarray, "3"], taken_in: float, shift: Float[np.ndarray, "3"]
) -> Volume:
    """Return the voxels whose centre lies in a lumen, or outside by up to a share of their edge in the plane."""
    k, j, i = np.nonzero(lumen.values > -_MARGIN_MM / 2)
    points = np.stack([i, j, k], axis=1) * lumen.spacing_mm + lumen.origin_mm
    origin = points.min(axis=0) - _MARGIN_MM + shift * voxel_mm
    count = np.ceil((points.max(axis=0) + _MARGIN_MM - origin) / voxel_mm).astype(int) + 1
    x, y, z = (origin[axis] + voxel_mm[axis] * np.arange(count[axis]) for axis in range(3))
    voxels = np.zeros((len(z), len(y), len(x)), dtype=bool)
    for index, height in enumerate(z):
        grid = np.stack(np.broadcast_arrays(x[None, :], y[:, None], height), axis=-1).reshape(-1, 3)
        voxels[index] = (sample(lumen, grid) > -taken_in * voxel_mm[0]).reshape(len(y), len(x))
    return Volume(voxels, voxel_mm, origin, np.eye(3))


CATHETER_LENGTH_MM = 30.0  # length of catheter behind the ostium that the distance map holds, mm

_KINDS: dict[str, Callable[[np.random.Generator, float, Population], tuple[VesselTree, dict[str, Any]]]] = {
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

    seen_through_ct: bool = False
    """Rasterise each patient at a coronary CT's resolution and make the anatomy of that mask, as of a real one: rough
    walls, wide narrow lumens, no branches thinner than the voxels. Takes some 5 s a patient."""

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
    population = population_of(config.vessel, config.population)
    generator = _stream(config, index, 1)
    name, source = f"{config.vessel}-{config.seed}-{index:04d}", {"source": "atlas", "vessel": config.vessel}
    source |= {"population": config.population, "seed": config.seed, "index": index}
    direction, catheter = catheter_direction(generator, tree, population, CATHETER_RADIUS_MM, CATHETER_LENGTH_MM)
    if config.seen_through_ct:
        tree = visible(generator, tree)
    lumen = distance.distance_map_from_spheres(tree, beside=flattened(generator, tree, population))
    if config.seen_through_ct:
        first = tangents(tree.branches[0].centerline.points)[0]
        found, scan = seen_through_ct(generator, config.vessel, tree, lumen, first, name, CATHETER_RADIUS_MM)
        return replace(found, provenance=source | drawn | {"seen_through_ct": scan})
    insertion = Insertion(position=tree.branches[0].centerline.points[0], direction=direction)
    return Anatomy(
        name=name,
        tree=tree,
        distance_map=distance.add_catheter(lumen, insertion, CATHETER_RADIUS_MM, CATHETER_LENGTH_MM),
        insertion=insertion,
        catheter_radius_mm=CATHETER_RADIUS_MM,
        provenance=source | drawn | catheter,
    )


def make_patient_tree(config: AtlasConfig, index: int) -> tuple[VesselTree, dict[str, Any]]:
    """Return the centerline tree of patient `index`, and what was drawn for it, without a distance map."""
    population = population_of(config.vessel, config.population)
    return _KINDS[config.vessel](_stream(config, index, 0), config.stenosis_share, population)


def _stream(config: AtlasConfig, index: int, purpose: int) -> np.random.Generator:
    """Return a patient's random stream for the tree (0), or for section and catheter (1)."""
    key = np.array([config.seed, index], dtype=np.uint64)
    return np.random.Generator(np.random.Philox(key=key, counter=np.array([0, 0, 0, purpose], dtype=np.uint64)))
