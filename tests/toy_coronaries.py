"""Synthetic patients' coronary arteries as masks without an aorta."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

from endopilot.anatomy.distance import distance_map_from_spheres, sample
from endopilot.atlas.atlas import AtlasConfig, make_patient_tree
from endopilot.types import LumenMask, Volume

VOXEL_MM = 0.7
LEFT_FROM_RIGHT_MM = np.array([12.0, 30.0, 13.0])
PLACE_MM = {"rca": np.zeros(3), "lca": LEFT_FROM_RIGHT_MM}


@cache
def artery(vessel):
    """The distance map of a synthetic artery whose ostium lies at `PLACE_MM`."""
    tree, _ = make_patient_tree(AtlasConfig(vessel=vessel, seed=5), 0)
    lumen = distance_map_from_spheres(tree, spacing_mm=VOXEL_MM)
    shift = PLACE_MM[vessel] - tree.branches[0].centerline.points[0]
    return replace(lumen, origin_mm=lumen.origin_mm + shift)


def mask_of_arteries(*lumens):
    """One mask of several lumens; its open ends are round."""
    lower = np.min([each.origin_mm for each in lumens], axis=0)
    sizes = [each.spacing_mm * np.array(each.values.shape[::-1]) for each in lumens]
    upper = np.max([each.origin_mm + size for each, size in zip(lumens, sizes, strict=True)], axis=0)
    count = np.ceil((upper - lower) / VOXEL_MM).astype(int)
    empty = Volume(np.zeros(count[::-1], dtype=bool), np.full(3, VOXEL_MM), lower, np.eye(3))
    voxels = empty.voxels.copy()
    for lumen in lumens:
        index = np.argwhere(lumen.values > -1.0)
        place = lumen.origin_mm + lumen.spacing_mm * index[:, ::-1]
        near = np.rint((place - lower) / VOXEL_MM).astype(int)
        near = near[((near >= 0) & (near < count)).all(axis=1)]
        inside = sample(lumen, empty.index_to_world(near.astype(float))) > 0
        voxels[tuple(near[inside][:, ::-1].T)] = True
    return LumenMask(replace(empty, voxels=voxels))


def without(mask, keep):
    """The mask with only the voxels for whose LPS positions `keep` is true."""
    index = np.argwhere(mask.volume.voxels)
    lost = ~keep(mask.volume.index_to_world(index[:, ::-1].astype(float)))
    voxels = mask.volume.voxels.copy()
    voxels[tuple(index[lost].T)] = False
    return replace(mask, volume=replace(mask.volume, voxels=voxels))
